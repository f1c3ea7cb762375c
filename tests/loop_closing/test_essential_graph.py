from __future__ import annotations

import pytest
import torch

from tests.loop_closing.ring import END, ring_submap, scaling_sim3
from tests.scene import Scene, pose
from torchslam.geometry import sim3_scale
from torchslam.loop_closing.loop_closer import (
    MIN_ESSENTIAL_WEIGHT,
    essential_edges,
    essential_graph_solution,
    loop_edge,
)
from torchslam.loop_closing.loop_detector import LoopCandidate
from torchslam.map.map import Map


def keyframes_that_see(*ranges: tuple[int, int]) -> Map:
    """Keyframes that see the points from ... to ... each."""
    scene = Scene.of(max(end for _, end in ranges))
    slam_map = Map()
    for index, (start, end) in enumerate(ranges):
        slam_map.add_keyframe(scene.view(index, pose()), pose())
        if index == 0:
            slam_map.add_points(scene.points_w, scene.descriptors, 0)
        seen = torch.arange(start, end)
        slam_map.add_observations(index, seen, seen)
    return slam_map


def edges(*ranges: tuple[int, int]) -> list[list[int]]:
    return essential_edges(keyframes_that_see(*ranges)).tolist()


def test_each_keyframe_is_joined_to_the_most_covisible_earlier_one() -> None:
    assert edges((0, 50), (20, 70), (45, 95), (10, 60)) == [[0, 1], [0, 3], [1, 2]]


def test_one_shared_point_is_an_edge() -> None:
    assert edges((0, 20), (30, 50), (19, 21)) == [[0, 1], [0, 2]]


def test_a_keyframe_without_shared_points_is_joined_to_the_previous_one() -> None:
    assert edges((0, 20), (15, 30), (40, 50)) == [[0, 1], [1, 2]]


def test_highly_covisible_keyframes_are_joined_as_well() -> None:
    assert MIN_ESSENTIAL_WEIGHT == 100
    assert edges((0, 150), (0, 120), (20, 150)) == [[0, 1], [0, 2], [1, 2]]
    assert edges((0, 150), (0, 119), (20, 150)) == [[0, 1], [0, 2]]
    assert edges((0, 150), (0, 120), (20, 150), (30, 150)) == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]


def test_a_single_keyframe_has_no_edges() -> None:
    assert essential_edges(keyframes_that_see((0, 5))).shape == (0, 2)


def test_the_scale_of_a_loop_is_distributed_over_its_way() -> None:
    """A loop that only asks for another scale, about the camera at its end."""
    submap = ring_submap()
    T_cw = submap.map.T_cw[END]
    S_21 = torch.linalg.inv(T_cw) @ scaling_sim3(1.3) @ T_cw
    S_cw = essential_graph_solution(loop_edge(LoopCandidate(submap, END, submap, END - 15, S_21)).graph)
    ratio = float(sim3_scale(S_cw[END - 15]) / sim3_scale(S_cw[END]))
    assert ratio == pytest.approx(1.3, abs=0.15)
