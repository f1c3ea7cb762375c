"""When a frame is kept: each reason from both sides of its threshold."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.map.simulated import estimate_at
from tests.scene import Scene, pose, sideways, submap_of_scene
from torchslam.config import KeyframesConfig
from torchslam.geometry.transforms import pose_distance
from torchslam.map.atlas import Submap
from torchslam.mapping import mapper
from torchslam.mapping.mapper import keyframe_reason

SCENE = Scene.of(100)
SETTINGS = KeyframesConfig()


def why(submap: Submap, T_cw: Tensor, *, index: int = 50, share: float = 1.0, backlog: int = 0) -> str:
    """Of a frame at T_cw that sees the points of keyframe 0, `share` of what its reference has."""
    seen = submap.map.observed_points(torch.tensor([0]))
    submap.tracking.reference_size = round(len(seen) / share)
    estimate = estimate_at(T_cw, seen, torch.arange(len(seen)), depth=depth(submap, T_cw))
    view = replace(SCENE.view(index, T_cw), backlog=backlog)
    return str(keyframe_reason(view, estimate, submap, SETTINGS) or "")


def depth(submap: Submap, T_cw: Tensor) -> float:
    seen = submap.map.observed_points(torch.tensor([0]))
    return float((submap.map.positions_w[seen] @ T_cw[2, :3] + T_cw[2, 3]).median())


def test_a_tenth_of_the_depth_makes_a_keyframe() -> None:
    submap = submap_of_scene(SCENE, sideways(1))
    step = SETTINGS.max_translation * depth(submap, pose())
    assert why(submap, pose(0.99 * step)) == ""
    assert why(submap, pose(1.01 * step)) == "moved by 0.10 of the scene depth"
    assert why(submap, pose(0, -2.0 * step)) == "moved by 0.20 of the scene depth"


def test_twelve_degrees_make_a_keyframe() -> None:
    submap = submap_of_scene(SCENE, sideways(1))
    turn = math.radians(SETTINGS.max_rotation_deg)
    assert why(submap, pose(0, 0, 0, 0, 0, 0.99 * turn)) == ""
    assert why(submap, pose(0, 0, 0, 0, 0, 1.1 * turn)) == "turned by 13.2 degrees"


def test_any_near_covisible_keyframe_is_enough() -> None:
    submap = submap_of_scene(SCENE, sideways(3, step=1.0))
    assert why(submap, sideways(1, start=0.98)[0]) == ""  # next to the second, far from the last
    assert why(submap, sideways(1, start=0.5)[0]).startswith("moved by 0.1")
    turned = pose(0, 0, 0, 0, 0, math.radians(20.0))
    # far from two, and turned away from the third: what it turned by says why
    assert why(submap, turned @ sideways(1, start=0.98)[0]) == "turned by 20.0 degrees"


def test_the_newest_keyframe_always_counts() -> None:
    submap = submap_of_scene(SCENE, sideways(3, step=1.0))
    submap.tracking.local_keyframes = torch.tensor([0])
    assert why(submap, sideways(1, start=1.0)[0]).startswith("moved")
    assert why(submap, sideways(1, start=2.0)[0]) == ""


def test_little_overlap_with_the_reference_makes_a_keyframe() -> None:
    submap = submap_of_scene(SCENE, sideways(1))
    assert why(submap, pose(), share=0.8) == ""
    assert why(submap, pose(), share=0.78).startswith("sees 78% of the points")
    assert why(submap, pose(), share=0.3).startswith("sees 30% of the points")


def test_a_reference_without_points_makes_no_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    submap = submap_of_scene(SCENE, sideways(1))
    seen = submap.map.observed_points(torch.tensor([0]))[:1]
    submap.tracking.reference_size = 0
    estimate = estimate_at(pose(), seen, torch.arange(1))
    monkeypatch.setattr(mapper, "MIN_POINTS", 0)
    assert keyframe_reason(SCENE.view(50, pose()), estimate, submap, SETTINGS) is None


def test_a_frame_with_few_points_becomes_a_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    submap = submap_of_scene(SCENE, sideways(1))
    seen = submap.map.observed_points(torch.tensor([0]))[:30]
    submap.tracking.reference_size = 30
    estimate = estimate_at(pose(), seen, torch.arange(30))
    reason = keyframe_reason(SCENE.view(50, pose()), estimate, submap, SETTINGS)
    assert str(reason) == "sees only 30 points of the map"
    monkeypatch.setattr(mapper, "MIN_POINTS", 30)
    assert keyframe_reason(SCENE.view(50, pose()), estimate, submap, SETTINGS) is None


def test_the_frame_of_the_newest_keyframe_is_no_other_one() -> None:
    submap = submap_of_scene(SCENE, sideways(1), first=20)
    far = pose(3.0)
    assert why(submap, far, index=20) == ""
    assert why(submap, far, index=21) != ""


def test_the_distance_between_cameras() -> None:
    here = pose(0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    there = torch.stack([pose(0.6, 0, 0.8) @ here, pose(0, 0, 0, 0, 0.3) @ here])
    translation, rotation = pose_distance(here, there, torch.tensor(4.0).double())
    assert translation.tolist() == pytest.approx([0.25, 0.0])
    assert rotation.tolist() == pytest.approx([0.0, math.degrees(0.3)], abs=1e-6)


def test_a_backlog_of_live_frames_delays_keyframes_while_overlap_suffices() -> None:
    submap = submap_of_scene(SCENE, sideways(1))
    far, age = pose(2.0 * SETTINGS.max_translation * depth(submap, pose())), 3
    assert why(submap, far, index=age, backlog=age) != ""
    assert why(submap, far, index=age, backlog=age + 1) == ""
    assert why(submap, far, index=age, backlog=age + 1, share=0.38) != ""
    assert why(submap, far, index=age, backlog=age + 1, share=0.42) == ""
