"""Maps and trajectories in the files of other programs: COLMAP, nerfstudio, PLY, rerun, TUM, KITTI."""
