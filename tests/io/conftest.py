"""The fixtures of a small run."""

from tests.sample_run import camera, results, run, slam_map, trajectory, world

__all__ = ["camera", "results", "run", "slam_map", "trajectory", "world"]
