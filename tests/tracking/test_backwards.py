"""The way back: who is posed, and where it ends."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, pose, sideways, world_in
from torchslam.config import Config, JudgeConfig
from torchslam.tracking.backwards import MISSES, track_back
from torchslam.tracking.tracker import Tracker
from torchslam.values import Tracked, View
from torchslam.world.world import World

SCENE = Scene.of(300)
AWAY = pose(0, 0, 0, 0, 3.0)  # looks back: sees nothing


def back(
    T_cw: Tensor, judge: JudgeConfig | None = None, noise: float = 0.0
) -> tuple[list[int], dict[int, Tensor]]:
    """Frames posed, and where, of cameras at T_cw (F, 4, 4), the first the one before the world's first keyframe."""
    world = world_in(SCENE, sideways(4), first=100)
    tracker = Tracker(CAMERA, Config())
    tracker.follow(world, 0)
    taken: dict[int, Tensor] = {}

    def take(where: World, view: View, tracked: Tracked) -> None:
        assert where is world
        taken[view.index] = tracked.T_cw

    views = [SCENE.view(99 - offset, T, noise=noise) for offset, T in enumerate(T_cw)]
    posed = track_back(tracker, world, views, judge or JudgeConfig(), take)
    assert [view.index for view in posed] == list(taken)
    return list(taken), taken


def test_frames_before_the_map_get_their_true_poses() -> None:
    T_cw = sideways(6, -0.05, start=-0.05)
    posed, poses = back(T_cw)
    assert posed == [99, 98, 97, 96, 95, 94]
    for index, found in poses.items():
        torch.testing.assert_close(found, T_cw[99 - index], atol=1e-7, rtol=0)


def test_a_few_frames_that_see_nothing_are_passed_over() -> None:
    T_cw = sideways(12, -0.02, start=-0.02)
    T_cw[2 : 2 + MISSES - 1] = AWAY
    T_cw[8 : 8 + MISSES - 1] = AWAY
    assert back(T_cw)[0] == [99, 98, 93, 92]


def test_many_frames_that_see_nothing_end_the_way() -> None:
    T_cw = sideways(10, -0.02, start=-0.02)
    T_cw[1 : 1 + MISSES] = AWAY
    assert back(T_cw)[0] == [99]


def test_frames_that_are_doubted_are_not_taken() -> None:
    T_cw = sideways(3, -0.05, start=-0.05)
    assert back(T_cw, noise=0.5)[0] == [99, 98, 97]
    assert back(T_cw, JudgeConfig(max_rotation_std_deg=1e-6), noise=0.5)[0] == []


def test_a_jump_from_where_the_motion_leads_is_doubted() -> None:
    T_cw = sideways(4, -0.05, start=-0.05)
    # the first frame has no motion to be compared with; the motion from the first to the third is too large
    judge = JudgeConfig(max_jump=0.03)
    T_cw[2:] = sideways(2, -0.05, start=-0.5)
    assert back(T_cw, judge)[0] == [99, 98]
