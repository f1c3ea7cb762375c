"""What a run remembers of its frames: poses that follow the map, and one problem of everything it saw."""

from __future__ import annotations

import copy

import pytest
import torch

from tests.map.simulated import estimate_at, simulated_submap
from tests.scene import CAMERA, Scene, pose, rows_of, sideways, submap_of_scene
from torchslam.geometry import SensorModel, se3_inverse
from torchslam.map.atlas import Submap
from torchslam.map.posed_frames import PosedFrames
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.run_graph import solve_graph

SCENE = Scene.of(150)


def submap_with_frames(noise: float = 0.0) -> Submap:
    """Two keyframes, and three frames that refer to the second."""
    submap = submap_of_scene(SCENE, sideways(2, step=0.5), noise=noise)
    for index, T_cw in enumerate(sideways(3, start=0.6), start=10):
        view = SCENE.view(index, T_cw, noise=noise)
        at = torch.nonzero(view.mask)[:, 0]
        ids = rows_of(SCENE)[SCENE.shows(index)][at]
        alive = submap.map.points["is_valid"][ids]
        T_cr = T_cw @ se3_inverse(submap.map.T_cw[1])
        submap.posed_frames.add(view, estimate_at(T_cw, ids[alive], at[alive]), T_cr, 1)
    return submap


def test_frames_follow_their_keyframe() -> None:
    submap = submap_with_frames()
    before = submap.posed_frames.T_cw(submap.map).clone()
    torch.testing.assert_close(before[2:], sideways(3, start=0.6))
    moved = pose(0, 0.3, 0, 0.1) @ submap.map.T_cw[1]
    inverse = se3_inverse(submap.map.T_cw[1])
    submap.map.keyframes["T_cw"][1] = moved
    after = submap.posed_frames.T_cw(submap.map)
    torch.testing.assert_close(after[2:], before[2:] @ inverse @ moved)
    torch.testing.assert_close(after[0], before[0])


def test_a_trajectory_is_in_order_of_time() -> None:
    submap = submap_with_frames()
    trajectory = submap.trajectory()
    assert (trajectory.timestamps.diff() > 0).all()
    torch.testing.assert_close(trajectory.T_wc[2:], se3_inverse(sideways(3, start=0.6)))
    submap.posed_frames.frames["timestamp"][:] = submap.posed_frames.frames["timestamp"].flip(0)
    torch.testing.assert_close(submap.trajectory().T_wc, trajectory.T_wc.flip(0))
    assert len(PosedFrames().trajectory(submap.map)) == 0


def test_the_run_graph_holds_all_observations() -> None:
    submap = submap_with_frames()
    graph = submap.posed_frames.graph(submap.map, SensorModel(CAMERA))
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
    torch.testing.assert_close(submap.map.positions_w[graph.point_ids], graph.points_w)


def test_frames_apply_a_solution_in_any_order() -> None:
    submap = submap_with_frames(noise=0.5)
    order = torch.tensor([3, 0, 4, 1, 2])
    shuffled = copy.deepcopy(submap)
    shuffled.posed_frames.frames.keep(order)
    shuffled.posed_frames.observations["frame_row"][:] = torch.argsort(order)[
        submap.posed_frames.observations["frame_row"]
    ]
    for one in (submap, shuffled):
        graph = one.posed_frames.graph(one.map, SensorModel(CAMERA))
        one.posed_frames.apply_solution(
            solve_graph(graph, options=GRAPH_OPTIONS.replace(backward="detached")), graph, one.map
        )
    torch.testing.assert_close(
        shuffled.posed_frames.T_cw(shuffled.map),
        submap.posed_frames.T_cw(submap.map)[order],
        atol=1e-7,
        rtol=0,
    )


def test_another_reference_moves_no_frame() -> None:
    submap = simulated_submap()
    before, references = (
        submap.posed_frames.T_cw(submap.map).clone(),
        submap.posed_frames.frames["reference_keyframe"].clone(),
    )
    replacement = torch.arange(submap.map.num_keyframes)
    replacement[2] = 0
    submap.posed_frames.reassign_reference(replacement, submap.map)
    torch.testing.assert_close(submap.posed_frames.T_cw(submap.map), before)
    assert (submap.posed_frames.frames["reference_keyframe"] != 2).all()
    assert torch.equal(
        submap.posed_frames.frames["reference_keyframe"][references != 2], references[references != 2]
    )


def test_a_scale_change_applies_around_each_keyframe() -> None:
    submap = submap_with_frames()
    before = submap.posed_frames.frames["T_cr"].clone()
    submap.posed_frames.rescale(torch.tensor([1.0, 3.0]).double())
    after = submap.posed_frames.frames["T_cr"]
    torch.testing.assert_close(after[2:, :3, 3], 3 * before[2:, :3, 3])
    torch.testing.assert_close(after[:, :3, :3], before[:, :3, :3])
    assert float(before[2:, :3, 3].norm()) == pytest.approx(float(after[2:, :3, 3].norm()) / 3)


def stray(submap: Submap, frame: int, count: int, shift: float = 60.0) -> None:
    """The first `count` things that a frame saw were seen elsewhere, by pixels of their scales."""
    seen = submap.posed_frames.observations
    rows = torch.nonzero(seen["frame_row"] == frame)[:count, 0]
    seen["pixels"][rows, 0] += shift * seen["scales"][rows]


def of_frames(submap: Submap) -> list[int]:
    """How many observations each frame has."""
    return torch.bincount(submap.posed_frames.observations["frame_row"]).tolist()


def test_outliers_of_frames_are_removed() -> None:
    submap = submap_with_frames()
    before, ids = of_frames(submap), submap.posed_frames.observations["point_ids"].clone()
    at = torch.nonzero(submap.posed_frames.observations["frame_row"] == 3)[:, 0]
    stray(submap, 3, 5)
    submap.posed_frames.remove_outliers(submap.map, SensorModel(CAMERA))
    assert [was - now for was, now in zip(before, of_frames(submap), strict=True)] == [0, 0, 0, 5, 0]
    seen = submap.posed_frames.observations
    assert torch.equal(seen["point_ids"][seen["frame_row"] == 3], ids[at[5:]])


@pytest.mark.parametrize(("off", "forgotten"), [(4.85, 0), (4.95, 5)])
def test_the_outlier_threshold_is_twice_the_inlier_threshold(off: float, forgotten: int) -> None:
    """sqrt(4 x 5.991) = 4.895"""
    submap = submap_with_frames()
    count = len(submap.posed_frames.observations)
    stray(submap, 3, 5, off)
    submap.posed_frames.remove_outliers(submap.map, SensorModel(CAMERA))
    assert count - len(submap.posed_frames.observations) == forgotten


def test_a_frame_with_few_inliers_keeps_all_observations() -> None:
    submap = submap_with_frames()
    before = of_frames(submap)
    stray(submap, 3, before[3] // 4 + 1)
    submap.posed_frames.remove_outliers(submap.map, SensorModel(CAMERA))
    assert of_frames(submap) == before
