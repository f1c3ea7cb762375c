"""A map that is returned to is byte by byte what it was, whatever was added and changed since."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.map.simulated import simulated_submap, view_of
from torchslam.geometry import se3_exp
from torchslam.map.map import Map, MapSnapshot


def columns(slam_map: Map) -> list[Tensor]:
    tables = (slam_map.points, slam_map.keyframes)
    return [column.clone() for table in tables for column in table.columns().values()]


def disturb(slam_map: Map, keyframes: int, points: int) -> None:
    """Add keyframes with points of their own, and change all that later keyframes may change."""
    generator = torch.Generator().manual_seed(1)
    around_w = torch.rand(points, 3, generator=generator, dtype=torch.float64)
    for k in range(keyframes):
        T_cw = se3_exp(0.1 * torch.randn(6, generator=generator, dtype=torch.float64))
        view = view_of(100 + k, T_cw, around_w, generator)
        keyframe = slam_map.add_keyframe(view, T_cw)
        ids = slam_map.add_points(around_w, view.descriptors, keyframe)
        slam_map.add_observations(keyframe, torch.arange(points), ids)
        slam_map.images[slam_map.key(keyframe)] = torch.zeros(1)
    slam_map.keyframes["T_cw"][:, :3, 3] += 1.0
    slam_map.keyframes["covariances"][:] *= 2.0
    slam_map.points["positions_w"][:] += 1.0
    slam_map.points["times_found"][:] += 3
    living = slam_map.valid_points()
    slam_map.merge_points(living[:4], living[-4:])
    slam_map.remove_points(living[5:9])
    seen = slam_map.observations(slam_map.index_tensor(0))
    slam_map.remove_observations(seen.keyframe_index[:2], seen.keypoint_index[:2])
    slam_map.update_appearance(torch.arange(slam_map.num_keyframes))


def test_a_snapshot_restores_the_map() -> None:
    slam_map, points = simulated_submap().map, torch.arange(10)
    slam_map.images[slam_map.key(0)] = torch.ones(1)
    before, observers = columns(slam_map), slam_map.count_observed(points)
    snapshot = MapSnapshot.of(slam_map)
    assert snapshot.num_keyframes == slam_map.num_keyframes
    for _ in range(2):  # a snapshot can be restored repeatedly
        disturb(slam_map, keyframes=70, points=40)  # more than there is room for
        assert slam_map.num_keyframes == snapshot.num_keyframes + 70
        snapshot.restore(slam_map)
        assert all(torch.equal(now, then) for now, then in zip(columns(slam_map), before, strict=True))
        assert torch.equal(slam_map.count_observed(points), observers)
        assert list(slam_map.images) == [slam_map.key(0)]


def test_a_snapshot_restores_the_noise() -> None:
    slam_map = simulated_submap().map
    slam_map.noise_variance = 1.5
    snapshot = MapSnapshot.of(slam_map)
    slam_map.noise_variance = 3.0
    snapshot.restore(slam_map)
    assert slam_map.noise_variance == 1.5
