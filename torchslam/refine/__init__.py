"""Poses and a camera of another program, made better by the images: matched, triangulated, adjusted, calibrated."""

from torchslam.refine.pose_refinement import CameraChoice, Refined, refine_poses

__all__ = ["CameraChoice", "Refined", "refine_poses"]
