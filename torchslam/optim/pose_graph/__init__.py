"""Pose graphs over SE(3) and Sim(3)."""
