"""Tracking: initialization, data association, pose estimation and validation, relocalization, backward tracking."""
