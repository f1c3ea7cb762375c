"""Pose of a single frame from its matches with the map."""
