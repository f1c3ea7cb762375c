"""The fixtures of a small run."""

from tests.sample_run import camera, results, slam_map, trajectory

__all__ = ["camera", "results", "slam_map", "trajectory"]
