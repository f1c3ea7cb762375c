"""Refine poses and camera of another program with the images: match, triangulate, adjust, calibrate."""

from torchslam.refine.pose_refinement import CameraChoice, RefinementResult, refine_poses

__all__ = ["CameraChoice", "RefinementResult", "refine_poses"]
