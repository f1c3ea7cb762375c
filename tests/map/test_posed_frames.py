"""What a run remembers of its frames: poses that follow the map, and one problem of everything it saw."""

from __future__ import annotations

import copy

import pytest
import torch

from tests.map.simulated import simulated_world, tracked_at
from tests.scene import CAMERA, Scene, pose, rows_of, sideways, world_in
from torchslam.geometry import se3_inverse
from torchslam.map.posed_frames import PosedFrames
from torchslam.map.submap import Submap
from torchslam.optim.run_graph import solve

SCENE = Scene.of(150)


def walked(noise: float = 0.0) -> Submap:
    """Two keyframes, and three frames that refer to the second."""
    world = world_in(SCENE, sideways(2, step=0.5), noise=noise)
    for index, T_cw in enumerate(sideways(3, start=0.6), start=10):
        view = SCENE.view(index, T_cw, noise=noise)
        at = torch.nonzero(view.mask)[:, 0]
        ids = rows_of(SCENE)[SCENE.shows(index)][at]
        alive = world.map.points["is_valid"][ids]
        T_cr = T_cw @ se3_inverse(world.map.T_cw[1])
        world.history.add(view, tracked_at(T_cw, ids[alive], at[alive]), T_cr, 1)
    return world


def test_frames_follow_their_keyframe() -> None:
    world = walked()
    before = world.history.T_cw(world.map).clone()
    torch.testing.assert_close(before[2:], sideways(3, start=0.6))
    moved = pose(0, 0.3, 0, 0.1) @ world.map.T_cw[1]
    inverse = se3_inverse(world.map.T_cw[1])
    world.map.keyframes["T_cw"][1] = moved
    after = world.history.T_cw(world.map)
    torch.testing.assert_close(after[2:], before[2:] @ inverse @ moved)
    torch.testing.assert_close(after[0], before[0])


def test_a_trajectory_is_in_order_of_time() -> None:
    world = walked()
    trajectory = world.trajectory()
    assert (trajectory.timestamps.diff() > 0).all()
    torch.testing.assert_close(trajectory.T_wc[2:], se3_inverse(sideways(3, start=0.6)))
    world.history.frames["timestamp"][:] = world.history.frames["timestamp"].flip(0)
    torch.testing.assert_close(world.trajectory().T_wc, trajectory.T_wc.flip(0))
    assert len(PosedFrames().trajectory(world.map)) == 0


def test_the_graph_of_a_run_holds_what_was_seen() -> None:
    world = walked()
    graph = world.history.graph(world.map, CAMERA)
    assert graph.frame_ids.tolist() == [0, 1, 10, 11, 12]
    assert graph.is_keyframe.tolist() == [True, True, False, False, False]
    torch.testing.assert_close(graph.T_cw, torch.cat([sideways(2, step=0.5), sideways(3, start=0.6)]))
    torch.testing.assert_close(graph.timestamps, 0.1 * graph.frame_ids.double())
    points_c = graph.T_cw[graph.frame_index] @ torch.nn.functional.pad(
        graph.points_w[graph.point_index], (0, 1), value=1.0
    ).unsqueeze(-1)
    torch.testing.assert_close(CAMERA.project(points_c[:, None, :3, 0])[0][:, 0], graph.pixels)
    for frame, index in enumerate((0, 1, 10, 11, 12)):
        seen = graph.frame_index == frame
        view = SCENE.view(index, graph.T_cw[frame])
        torch.testing.assert_close(view.keypoints[graph.keypoint_index[seen]], graph.pixels[seen])
        torch.testing.assert_close(view.scales[graph.keypoint_index[seen]] ** -2, graph.weights[seen])
        assert int(seen.sum()) > 50
    torch.testing.assert_close(world.map.positions_w[graph.point_ids], graph.points_w)


def test_map_and_frames_take_over_the_solution_of_their_graph() -> None:
    world = walked(noise=0.5)
    graph = world.history.graph(world.map, CAMERA)
    solution = solve(graph, backward="detached")
    world.history.take(solution, graph, world.map)
    torch.testing.assert_close(world.map.T_cw, solution.T_cw[:2])
    torch.testing.assert_close(world.history.T_cw(world.map), solution.T_cw)
    torch.testing.assert_close(world.map.positions_w[graph.point_ids], solution.points_w)
    (bundle,) = solution.keyframes
    marginals = bundle.covariance()
    torch.testing.assert_close(world.map.keyframes["covariances"], marginals.frames)
    assert float(world.map.keyframes["covariances"][1].trace()) > 0
    assert float(world.map.points["covariances_w"][graph.point_ids].sum()) > 0


def test_frames_take_over_wherever_they_stand_in_the_history() -> None:
    world = walked(noise=0.5)
    order = torch.tensor([3, 0, 4, 1, 2])
    shuffled = copy.deepcopy(world)
    shuffled.history.frames.keep(order)
    shuffled.history.observations["frame_row"][:] = torch.argsort(order)[
        world.history.observations["frame_row"]
    ]
    for one in (world, shuffled):
        graph = one.history.graph(one.map, CAMERA)
        one.history.take(solve(graph, backward="detached"), graph, one.map)
    torch.testing.assert_close(
        shuffled.history.T_cw(shuffled.map), world.history.T_cw(world.map)[order], atol=1e-7, rtol=0
    )


def test_another_reference_moves_nobody() -> None:
    world = simulated_world()
    before, references = (
        world.history.T_cw(world.map).clone(),
        world.history.frames["reference_keyframe"].clone(),
    )
    heirs = torch.arange(world.map.num_keyframes)
    heirs[2] = 0
    world.history.refer(heirs, world.map)
    torch.testing.assert_close(world.history.T_cw(world.map), before)
    assert (world.history.frames["reference_keyframe"] != 2).all()
    assert torch.equal(
        world.history.frames["reference_keyframe"][references != 2], references[references != 2]
    )


def test_units_change_around_each_keyframe() -> None:
    world = walked()
    before = world.history.frames["T_cr"].clone()
    world.history.rescale(torch.tensor([1.0, 3.0]).double())
    after = world.history.frames["T_cr"]
    torch.testing.assert_close(after[2:, :3, 3], 3 * before[2:, :3, 3])
    torch.testing.assert_close(after[:, :3, :3], before[:, :3, :3])
    assert float(before[2:, :3, 3].norm()) == pytest.approx(float(after[2:, :3, 3].norm()) / 3)


def stray(world: Submap, frame: int, count: int, shift: float = 60.0) -> None:
    """The first `count` things that a frame saw were seen elsewhere, by pixels of their scales."""
    seen = world.history.observations
    rows = torch.nonzero(seen["frame_row"] == frame)[:count, 0]
    seen["pixels"][rows, 0] += shift * seen["scales"][rows]


def of_frames(world: Submap) -> list[int]:
    """How many observations each frame has."""
    return torch.bincount(world.history.observations["frame_row"]).tolist()


def test_what_is_far_astray_is_forgotten() -> None:
    world = walked()
    before, ids = of_frames(world), world.history.observations["point_ids"].clone()
    at = torch.nonzero(world.history.observations["frame_row"] == 3)[:, 0]
    stray(world, 3, 5)
    world.history.forget_strays(world.map, CAMERA)
    assert [was - now for was, now in zip(before, of_frames(world), strict=True)] == [0, 0, 0, 5, 0]
    seen = world.history.observations
    assert torch.equal(seen["point_ids"][seen["frame_row"] == 3], ids[at[5:]])


@pytest.mark.parametrize(("off", "forgotten"), [(4.85, 0), (4.95, 5)])
def test_astray_is_twice_as_far_as_agrees(off: float, forgotten: int) -> None:
    """sqrt(4 x 5.991) = 4.895"""
    world = walked()
    count = len(world.history.observations)
    stray(world, 3, 5, off)
    world.history.forget_strays(world.map, CAMERA)
    assert count - len(world.history.observations) == forgotten


def test_a_frame_that_agrees_with_little_keeps_all() -> None:
    world = walked()
    before = of_frames(world)
    stray(world, 3, before[3] // 4 + 1)
    world.history.forget_strays(world.map, CAMERA)
    assert of_frames(world) == before


def test_a_stray_does_not_pull_its_frame() -> None:
    world = walked()
    truth = world.history.T_cw(world.map)[3].clone()
    stray(world, 3, 3)

    def off() -> float:
        graph = world.history.graph(world.map, CAMERA)
        row = int(torch.nonzero(graph.frame_ids == 11)[0])
        T_cw = solve(graph, backward="detached").T_cw[row]
        return float((T_cw @ se3_inverse(truth))[:3, 3].norm())

    assert off() > 1e-3
    world.history.forget_strays(world.map, CAMERA)
    assert off() < 1e-9
