"""Drifted loops are closed, and submaps are merged."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.loop_closing.ring import END, around, ring, ring_submap
from tests.scene import CAMERA, Scene, camera_center, moved, pose, rows_of, sideways, submap_of_scene
from torchslam.config import Config, load_config
from torchslam.geometry import SharedCamera, se3_inverse, sim3_inverse
from torchslam.geometry.similarity import umeyama
from torchslam.loop_closing.loop_closer import (
    LoopCloser,
    close_loop,
    earlier_visit_keyframes,
    essential_graph_solution,
    fuse_and_adjust,
    fuse_landmarks,
    fuse_with_earlier_visits,
    loop_edge,
    merge_maps,
)
from torchslam.loop_closing.loop_detector import LoopCandidate
from torchslam.loop_closing.records import pack_closures, unpack_closures
from torchslam.map.atlas import Atlas, Submap
from torchslam.optim import solve_pose_graph
from torchslam.tracking.tracker import Tracker

CONFIG = Config()
SCENE = Scene.of(300)
ROWS = rows_of(SCENE)
OTHER = pose(0, 0, 0, 0.0, 0.05, 0.1) @ sideways(4, start=0.08)


def error(submap: Submap) -> float:
    """The root mean square error of the keyframes, aligned to the truth."""
    estimate, truth = camera_center(submap.map.T_cw), camera_center(around())
    scale, R, t = umeyama(estimate, truth)
    return float((scale * estimate @ R.mT + t - truth).square().sum(-1).mean().sqrt())


def loop(submap: Submap) -> LoopCandidate:
    detector = LoopCloser(SharedCamera(CAMERA), CONFIG, Atlas(CAMERA.params)).loop_detector
    found = detector.estimate(submap.map, END, submap.map, 0)
    assert found is not None
    return LoopCandidate(submap, END, submap, 0, *found)


def test_a_drifted_loop_is_closed() -> None:
    submap = ring_submap(scale=1.01, twist=0.002)
    assert error(submap) > 0.1
    points = submap.map.num_points
    found = loop(submap)
    close_loop(found, loop_edge(found).graph, CAMERA, CONFIG)
    assert error(submap) < 2e-3
    visible = {int(p) for k, T in enumerate(around()) for p in visible_points(k, T)}
    assert submap.map.num_points <= len(visible) + 0.02 * points < points
    assert int(submap.map.count_observed(submap.map.observed_points(torch.tensor([0])))[END]) > 50


def visible_points(keyframe: int, T_cw: Tensor) -> Tensor:
    view = ring().view(keyframe, T_cw)
    return ring().shows(keyframe)[view.mask]


def test_the_pose_graph_distributes_the_drift_along_the_loop() -> None:
    submap = ring_submap(scale=1.01, twist=0.002)
    found = loop(submap)
    S_cw = essential_graph_solution(loop_edge(found).graph)
    torch.testing.assert_close(S_cw[0], submap.map.T_cw[0])
    # the loop is closed: the end lies to the place as it was detected, but for what the other ties pull
    wanted = submap.map.T_cw[END] @ sim3_inverse(found.S_21) @ se3_inverse(submap.map.T_cw[0])
    closed = S_cw[END] @ sim3_inverse(S_cw[0])
    before = submap.map.T_cw[END] @ se3_inverse(submap.map.T_cw[0])
    assert float((closed - wanted).norm()) < 0.15 * float((before - wanted).norm())
    unit = torch.linalg.det(S_cw[:, :3, :3]) ** (1 / 3)
    assert (unit.diff() < 0).all() or (unit.diff() > 0).all()
    submap.apply_sim3_correction(S_cw)
    assert error(submap) < 0.1


def test_the_pose_graph_of_a_closed_loop_has_a_gradient_to_its_matches() -> None:
    submap = ring_submap(scale=1.01, twist=0.002)
    closer = LoopCloser(SharedCamera(CAMERA), CONFIG, Atlas(CAMERA.params))
    with torch.inference_mode():
        found = loop(submap)
        expected = essential_graph_solution(loop_edge(found).graph)
        closer.close(found)
    tensors, about = pack_closures(closer.loop_closures)
    (record,) = unpack_closures(tensors, about)
    assert (record.frame, record.matched_frame, record.edge is None) == (END, 0, False)
    edge = record.edge
    assert edge is not None
    torch.testing.assert_close(
        essential_graph_solution(edge.graph), expected.clone()
    )  # before the correction
    assert edge.frame_ids[edge.edges[-1]].tolist() == [0, END]
    weights = torch.ones(len(edge.matches.points_k), dtype=torch.float64, requires_grad=True)
    scale, R, t = umeyama(edge.matches.points_m, edge.matches.points_k, weights)
    torch.testing.assert_close(scale * R, edge.S_ji[-1, :3, :3], atol=0.05, rtol=0)  # of a bent map
    S_km = torch.cat((torch.cat((scale * R, t[:, None]), 1), edge.S_ji[-1, 3:]))
    graph = replace(edge.graph, S_ji=torch.cat((edge.S_ji[:-1], S_km[None])))
    solve_pose_graph(graph).S_cw[END // 2, 0, 3].backward()
    assert weights.grad is not None
    assert bool(weights.grad.any())
    tensors["loops.0.edges"] = tensors["loops.0.edges"] + END + 1
    with pytest.raises(ValueError, match="loop 0: edges"):
        unpack_closures(tensors, about)


def test_a_loop_without_drift_moves_nothing() -> None:
    submap = ring_submap()
    T_cw = submap.map.T_cw.clone()
    found = loop(submap)
    close_loop(found, loop_edge(found).graph, CAMERA, CONFIG)
    torch.testing.assert_close(submap.map.T_cw, T_cw, atol=1e-4, rtol=0)
    torch.testing.assert_close(submap.posed_frames.T_cw(submap.map), T_cw, atol=1e-4, rtol=0)


def test_the_final_adjustment_can_be_left_out() -> None:
    submap = ring_submap(scale=1.01, twist=0.002)
    found = loop(submap)
    T_cw = essential_graph_solution(loop_edge(found).graph)
    close_loop(found, loop_edge(found).graph, CAMERA, load_config(None, ["paper.unrefined=true"]))
    unit = torch.linalg.det(T_cw[:, :3, :3]) ** (1 / 3)
    torch.testing.assert_close(submap.map.T_cw[:, :3, :3], T_cw[:, :3, :3] / unit[:, None, None])
    torch.testing.assert_close(submap.map.T_cw[:, :3, 3], T_cw[:, :3, 3] / unit[:, None])
    assert len(submap.map.observed_points(torch.tensor([0]))) > 0


@pytest.mark.parametrize("query", ["newer", "older"])
def test_two_submaps_are_merged(S_21: Tensor, query: str) -> None:
    older = submap_of_scene(SCENE, sideways(4), number=0)
    newer = submap_of_scene(SCENE, OTHER, S_ws=S_21, first=100, number=1)
    if query == "newer":
        found = LoopCandidate(newer, 3, older, 2, sim3_inverse(S_21))
    else:
        found = LoopCandidate(older, 3, newer, 2, S_21)
    camera = newer if query == "newer" else older
    last = moved(camera.T_cw, sim3_inverse(S_21)) if query == "newer" else camera.T_cw.clone()
    submap, keyframe = merge_maps(found, CAMERA, CONFIG)
    assert submap is older
    assert submap.map.num_keyframes == 8
    assert len(newer.map.keyframes) == 0
    assert int(submap.map.keyframes["frame_index"][keyframe]) == (103 if query == "newer" else 3)
    torch.testing.assert_close(submap.map.T_cw, torch.cat([sideways(4), OTHER]), atol=1e-5, rtol=0)
    torch.testing.assert_close(submap.T_cw, last, atol=1e-5, rtol=0)
    torch.testing.assert_close(submap.posed_frames.T_cw(submap.map), submap.map.T_cw, atol=1e-5, rtol=0)
    once = {tuple(row) for row in submap.map.points["descriptors"][submap.map.valid_points()].tolist()}
    assert len(once) == submap.map.num_points  # every point of the scene is there once
    shared = submap.map.count_observed(submap.map.observed_points(torch.tensor([1])))
    assert int(shared[6]) > 100


# --- two visits -------------------------------------------------------------------------------------------------

VISIT = 4  # keyframes


def two_visits(S_21: Tensor, tied: int = 60, between: bool = True) -> Submap:
    """A place seen by four keyframes, then something else, then by four others: of its points `tied` are tied."""
    submap = submap_of_scene(SCENE, sideways(VISIT))
    if between:
        submap.merge(
            submap_of_scene(SCENE, sideways(2), S_ws=pose(50.0), first=50), pose(-50.0) @ pose(0, 0, 90.0)
        )
    first = submap.map.num_keyframes
    submap.merge(submap_of_scene(SCENE, OTHER, S_ws=S_21, first=100), sim3_inverse(S_21))
    looks = submap.map.points["descriptors"].long() @ torch.arange(1, 33)
    early, late = (submap.map.observed_points(torch.arange(start, start + VISIT)) for start in (0, first))
    same = torch.nonzero(looks[late][:, None] == looks[early])[:tied]
    submap.map.merge_points(late[same[:, 0]], early[same[:, 1]])
    submap.map.update_appearance(torch.arange(submap.map.num_keyframes))
    Tracker(SharedCamera(CAMERA), CONFIG).reset_to_keyframe(submap, submap.map.num_keyframes - 1)
    return submap


def test_earlier_visits_are_keyframes_of_another_time(S_21: Tensor) -> None:
    submap = two_visits(S_21)
    last = submap.map.num_keyframes - 1
    assert set(earlier_visit_keyframes(submap.map, last).tolist()) == {0, 1, 2, 3}
    assert earlier_visit_keyframes(submap.map, 3).tolist() == []
    assert earlier_visit_keyframes(two_visits(S_21, tied=14).map, last).tolist() == []
    assert earlier_visit_keyframes(two_visits(S_21, between=False).map, last - 2).tolist() == []


def test_visits_are_separated_by_frame_time(S_21: Tensor) -> None:
    submap = two_visits(S_21)
    frames = submap.map.keyframes["frame_index"]
    frames[:] = frames.max() - frames  # the last keyframe came first
    assert earlier_visit_keyframes(submap.map, submap.map.num_keyframes - 1).tolist() == []
    assert set(earlier_visit_keyframes(submap.map, 0).tolist()) == {6, 7, 8, 9}


def test_a_new_keyframe_is_fused_with_every_keyframe_of_an_earlier_visit(S_21: Tensor) -> None:
    submap = two_visits(S_21)
    last = submap.map.num_keyframes - 1
    early = torch.arange(VISIT)
    before = int(submap.map.count_observed(submap.map.observed_points(early))[last])
    fuse_with_earlier_visits(submap, last, CAMERA, CONFIG)
    seen = submap.map.observed_points(torch.tensor([last]))
    visible = submap.map.observed_points(early)
    after = int(submap.map.count_observed(visible)[last])
    assert after > 2 * before
    assert int(submap.map.count_observed(seen)[early].min()) > 0.8 * after
    # the track looks for what is alive
    assert bool(submap.map.points["is_valid"][submap.tracking.local_points].all())
    assert bool(submap.map.points["is_valid"][submap.tracking.last_inlier_points].all())
    assert bool(torch.isin(seen, submap.tracking.local_points).all())


def test_without_an_earlier_visit_nothing_is_fused(S_21: Tensor) -> None:
    submap = two_visits(S_21, tied=0)
    table = submap.map.keyframes["point_ids"].clone()
    fuse_with_earlier_visits(submap, submap.map.num_keyframes - 1, CAMERA, CONFIG)
    assert torch.equal(submap.map.keyframes["point_ids"], table)


def test_landmarks_are_fused_from_both_sides(S_21: Tensor) -> None:
    """What one side's keyframes see no point at is filled by the points of the other side, and the other way round."""
    submap = two_visits(S_21, tied=0, between=False)
    here, there = torch.arange(VISIT, 2 * VISIT), torch.arange(VISIT)
    for one in (1, VISIT + 2):
        seen = submap.map.keyframes["point_ids"][one]
        keypoints = torch.nonzero(seen >= 0)[:, 0]
        submap.map.remove_observations(torch.full_like(keypoints, one), keypoints)
    fuse_landmarks(submap.map, here, there, CAMERA, CONFIG)
    assert int(submap.map.count_observed(submap.map.observed_points(here))[1]) > 100
    assert int(submap.map.count_observed(submap.map.observed_points(there))[VISIT + 2]) > 100


def test_duplicates_found_after_the_adjustment_are_merged_too(S_21: Tensor) -> None:
    """The two sides lie 4 px apart: at first only coarse keypoints are near enough, adjusted all are."""
    counts = []
    for override in ("paper.unrefined=true", "paper.unrefined=false"):
        submap = submap_of_scene(SCENE, sideways(4))
        submap.merge(submap_of_scene(SCENE, OTHER, S_ws=S_21, first=100), pose(0.08) @ sim3_inverse(S_21))
        fuse_and_adjust(submap, 5, 1, CAMERA, load_config(None, [override]))
        looks = {tuple(row) for row in submap.map.points["descriptors"][submap.map.valid_points()].tolist()}
        counts.append((submap.map.num_points, len(looks)))
    (loose, _), (tied, different) = counts
    assert loose > 1.2 * different
    assert tied == different


def test_the_loop_closer_fuses_earlier_visits_without_detection(S_21: Tensor) -> None:
    for enabled in (True, False):
        submap, atlas = two_visits(S_21), Atlas(CAMERA.params)
        atlas._submaps = [submap]
        memory = LoopCloser(
            SharedCamera(CAMERA), load_config(None, [f"loop_closing.enabled={str(enabled).lower()}"]), atlas
        )
        last = submap.map.num_keyframes - 1
        points = submap.map.num_points
        assert memory.detect(submap, last) is None
        assert submap.map.num_points == points
        memory.fuse_with_earlier_visits(submap, last)
        assert (submap.map.num_points < points) is enabled
