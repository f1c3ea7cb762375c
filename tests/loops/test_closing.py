"""Loops that drifted come back, and worlds become one."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.loops.ring import END, around, ring, ring_world
from tests.scene import CAMERA, Scene, centre, moved, pose, rows_of, sideways, world_in
from torchslam.config import Config, load_config
from torchslam.geometry import se3_inverse, sim3_inverse
from torchslam.geometry.alignment import umeyama
from torchslam.loops.closing import close_loop, corrected, join, weld
from torchslam.loops.recognition import Recognition
from torchslam.loops.relation import Relation, relate
from torchslam.world.world import World

CONFIG = Config()
SCENE = Scene.of(300)
ROWS = rows_of(SCENE)
OTHER = pose(0, 0, 0, 0.0, 0.05, 0.1) @ sideways(4, start=0.08)


def error(world: World) -> float:
    """The root mean square error of the keyframes, aligned to the truth."""
    estimate, truth = centre(world.map.T_cw), centre(around())
    scale, R, t = umeyama(estimate, truth)
    return float((scale * estimate @ R.mT + t - truth).square().sum(-1).mean().sqrt())


def loop(world: World) -> Recognition:
    relation = relate(world.map, END, world.map, 0, CAMERA, CONFIG)
    assert relation is not None
    return Recognition(world, END, world, 0, relation)


def test_a_way_that_drifted_comes_back() -> None:
    world = ring_world(scale=1.01, twist=0.002)
    assert error(world) > 0.1
    points = world.map.num_points
    close_loop(loop(world), CAMERA, CONFIG)
    assert error(world) < 2e-3
    visible = {int(p) for k, T in enumerate(around()) for p in visible_points(k, T)}
    assert world.map.num_points <= len(visible) + 0.02 * points < points
    assert int(world.map.observers(world.map.points_seen_by(torch.tensor([0])))[END]) > 50


def visible_points(keyframe: int, T_cw: Tensor) -> Tensor:
    view = ring().view(keyframe, T_cw)
    return ring().shows(keyframe)[view.mask]


def test_the_graph_alone_spreads_the_drift_over_the_way() -> None:
    world = ring_world(scale=1.01, twist=0.002)
    found = loop(world)
    S_cw = corrected(found)
    torch.testing.assert_close(S_cw[0], world.map.T_cw[0])
    # the loop is closed: the end lies to the place as it was recognised to, but for what the other ties pull
    wanted = world.map.T_cw[END] @ sim3_inverse(found.relation.S_21) @ se3_inverse(world.map.T_cw[0])
    closed = S_cw[END] @ sim3_inverse(S_cw[0])
    before = world.map.T_cw[END] @ se3_inverse(world.map.T_cw[0])
    assert float((closed - wanted).norm()) < 0.15 * float((before - wanted).norm())
    unit = torch.linalg.det(S_cw[:, :3, :3]) ** (1 / 3)
    assert (unit.diff() < 0).all() or (unit.diff() > 0).all()
    world.correct(S_cw)
    assert error(world) < 0.1


def test_without_a_drift_nothing_moves() -> None:
    world = ring_world()
    T_cw = world.map.T_cw.clone()
    close_loop(loop(world), CAMERA, CONFIG)
    torch.testing.assert_close(world.map.T_cw, T_cw, atol=1e-4, rtol=0)
    torch.testing.assert_close(world.history.T_cw(world.map), T_cw, atol=1e-4, rtol=0)


def test_the_final_adjustment_can_be_left_out() -> None:
    for override in ("loops.adjust=false", "bundle.enabled=false"):
        world = ring_world(scale=1.01, twist=0.002)
        found = loop(world)
        T_cw = corrected(found)
        close_loop(found, CAMERA, load_config(None, [override]))
        unit = torch.linalg.det(T_cw[:, :3, :3]) ** (1 / 3)
        torch.testing.assert_close(world.map.T_cw[:, :3, :3], T_cw[:, :3, :3] / unit[:, None, None])
        torch.testing.assert_close(world.map.T_cw[:, :3, 3], T_cw[:, :3, 3] / unit[:, None])
        assert len(world.map.points_seen_by(torch.tensor([0]))) > 0


@pytest.mark.parametrize("asks", ["younger", "older"])
def test_two_worlds_become_one(S_21: Tensor, asks: str) -> None:
    older = world_in(SCENE, sideways(4), number=0)
    younger = world_in(SCENE, OTHER, S_ws=S_21, first=100, number=1)
    if asks == "younger":
        found = Recognition(younger, 3, older, 2, Relation(sim3_inverse(S_21), 0, 0, 0))
    else:
        found = Recognition(older, 3, younger, 2, Relation(S_21, 0, 0, 0))
    camera = younger if asks == "younger" else older
    last = moved(camera.T_cw, sim3_inverse(S_21)) if asks == "younger" else camera.T_cw.clone()
    world, keyframe = join(found, CAMERA, CONFIG)
    assert world is older
    assert world.map.num_keyframes == 8
    assert len(younger.map.keyframes) == 0
    assert int(world.map.keyframes["frame_index"][keyframe]) == (103 if asks == "younger" else 3)
    torch.testing.assert_close(world.map.T_cw, torch.cat([sideways(4), OTHER]), atol=1e-5, rtol=0)
    torch.testing.assert_close(world.T_cw, last, atol=1e-5, rtol=0)
    torch.testing.assert_close(world.history.T_cw(world.map), world.map.T_cw, atol=1e-5, rtol=0)
    once = {tuple(row) for row in world.map.points["descriptors"][world.map.living_points()].tolist()}
    assert len(once) == world.map.num_points  # every point of the scene is there once
    shared = world.map.observers(world.map.points_seen_by(torch.tensor([1])))
    assert int(shared[6]) > 100


def test_welding_merges_around_both_places(S_21: Tensor) -> None:
    world = world_in(SCENE, sideways(4))
    world.absorb(world_in(SCENE, OTHER, S_ws=S_21, first=100), sim3_inverse(S_21))
    count = world.map.num_points
    weld(world, 5, 1, CAMERA, CONFIG)
    assert world.map.num_points < 0.6 * count
    looks = {tuple(row) for row in world.map.points["descriptors"][world.map.living_points()].tolist()}
    assert len(looks) == world.map.num_points
