"""The walk of the mapping benchmark is one that the system maps."""

from __future__ import annotations

import torch

from experiments.benchmarks.mapping import CAMERA, Walk
from torchslam.geometry import passes_gate, transform


def test_the_next_keyframes_see_old_and_new_points() -> None:
    with torch.inference_mode():
        walk = Walk(12)
        slam_map = walk.submap.map
        before = len(slam_map.points)
        for _ in range(2):
            assert set(walk.next()) == {
                "mapping, bundle",
                "loop closer",
                "local map",
                "loop detection",
                "culling, compaction",
            }
        assert slam_map.num_keyframes == 14
        seen = slam_map.observations(torch.tensor([13]))
        assert int((seen.point_index < before).sum()) > 200
        assert int((seen.point_index >= before).sum()) > 50
        points_c = transform(slam_map.T_cw[13], slam_map.positions_w[seen.point_index])
        errors = seen.noise.squared_reprojection(points_c, seen.pixels, CAMERA)
        assert float(passes_gate(errors).double().mean()) > 0.95
