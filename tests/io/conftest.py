"""The fixtures of a small run."""

from tests.sample_run import camera, results, run, slam_map, submap, trajectory

__all__ = ["camera", "results", "run", "slam_map", "submap", "trajectory"]
