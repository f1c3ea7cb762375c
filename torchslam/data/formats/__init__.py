"""File formats: images, text, calibrations, trajectories, poses of other programs."""
