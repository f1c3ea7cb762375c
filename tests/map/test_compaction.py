"""Removing keyframes and points leaves the rest of a submap unchanged."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from tests.map.simulated import CAMERA, path, reprojection_errors, simulated_submap, view_of
from tests.map.test_observation_index import check
from torchslam.geometry import SensorModel
from torchslam.map import compaction
from torchslam.map.atlas import Submap
from torchslam.map.compaction import compact, remove_invalid_rows, remove_keyframes
from torchslam.map.posed_frames import RunGraph

GONE = torch.tensor([1, 3])
FRAMES = 20


@pytest.fixture
def submap() -> Submap:
    """Seven keyframes, the last one the track's reference."""
    return simulated_submap(frames=FRAMES)


def pairs(graph: RunGraph) -> dict[tuple[int, int], tuple[float, float]]:
    """Which frame sees something at which keypoint, and where."""
    frames = graph.frame_ids[graph.frame_index].tolist()
    pixels = [(u, v) for u, v in graph.pixels.tolist()]
    return dict(zip(zip(frames, graph.keypoint_index.tolist(), strict=True), pixels, strict=True))


def seen_points(graph: RunGraph) -> dict[tuple[int, int], list[float]]:
    """Where the points are that the frames see at their keypoints."""
    frames = graph.frame_ids[graph.frame_index].tolist()
    points_w = graph.points_w[graph.point_index].tolist()
    return dict(zip(zip(frames, graph.keypoint_index.tolist(), strict=True), points_w, strict=True))


def by_frame(graph: RunGraph) -> Tensor:
    return graph.T_cw[torch.argsort(graph.frame_ids)]


def test_removing_keyframes_moves_no_frame(submap: Submap) -> None:
    before = copy.deepcopy(submap)
    remove_keyframes(submap, GONE)
    torch.testing.assert_close(submap.posed_frames.T_cw(submap.map), before.posed_frames.T_cw(before.map))
    torch.testing.assert_close(submap.T_cw, before.T_cw)
    trajectory = submap.trajectory()
    assert torch.equal(trajectory.timestamps, before.trajectory().timestamps)
    assert int(submap.posed_frames.frames["reference_keyframe"].max()) < submap.map.num_keyframes == 5


def test_the_other_keyframes_keep_their_observations(submap: Submap) -> None:
    before = copy.deepcopy(submap)
    renumbering = remove_keyframes(submap, GONE)
    assert renumbering.keyframes.tolist() == [0, -1, 1, -1, 2, 3, 4]
    stays = renumbering.keyframes >= 0
    for name, column in submap.map.keyframes.columns().items():
        if name != "point_ids":
            assert torch.equal(column, before.map.keyframes[name][stays]), name
    old, new = before.map.keyframes["point_ids"][stays], submap.map.keyframes["point_ids"]
    alive = submap.map.points["is_valid"]
    assert torch.equal(torch.where((old >= 0) & alive[old], old, -1), new)
    assert not bool((alive & (submap.map.points["times_observed"] < 2)).any())
    check(submap.map)


def test_points_are_assigned_to_a_keyframe_that_observes_them(submap: Submap) -> None:
    made_by_gone = torch.isin(submap.map.points["first_keyframe"], GONE)
    assert int(made_by_gone.sum()) > 0
    remove_keyframes(submap, GONE)
    points = submap.map.points
    table = submap.map.keyframes["point_ids"]
    for point in torch.nonzero(points["is_valid"] & made_by_gone)[:, 0].tolist():
        assert int(torch.nonzero((table == point).any(1))[0]) == points["first_keyframe"][point]
    assert int(points["first_keyframe"].max()) < submap.map.num_keyframes


def test_the_graph_keeps_observations_of_removed_keyframes(submap: Submap) -> None:
    """Not what their frames were tracked with: a dropped observation stays dropped, a new one stays."""
    keyframe = int(GONE[1])
    seen = torch.nonzero(submap.map.keyframes["point_ids"][keyframe] >= 0)[:, 0]
    submap.map.remove_observations(GONE[1:], seen[:1])
    first = submap.map.keyframes["point_ids"][keyframe]
    free, others = torch.nonzero(first < 0)[1:2, 0], submap.map.observed_points(torch.tensor([2]))
    submap.map.add_observations(keyframe, free, others[~torch.isin(others, first)][:1])
    before = copy.deepcopy(submap)
    remove_keyframes(submap, GONE)
    old, new = (each.posed_frames.graph(each.map, SensorModel(CAMERA)) for each in (before, submap))
    assert int(new.is_keyframe.sum()) == int(old.is_keyframe.sum()) - 2
    assert sorted(new.frame_ids.tolist()) == sorted(old.frame_ids.tolist())
    torch.testing.assert_close(by_frame(new), by_frame(old))
    frame = int(before.map.keyframes["frame_index"][keyframe])
    assert (frame, int(seen[0])) not in pairs(new)
    assert (frame, int(free[0])) in pairs(new)
    dead = before.map.points["is_valid"] & ~submap.map.points["is_valid"]
    gone_points = before.map.positions_w[dead].tolist()
    expected = {key: where for key, where in seen_points(old).items() if where not in gone_points}
    assert seen_points(new) == expected
    assert all(pairs(old)[key] == pixel for key, pixel in pairs(new).items())


def test_a_keyframe_whose_frame_was_never_added_becomes_a_frame(submap: Submap) -> None:
    generator = torch.Generator().manual_seed(5)
    T_cw = path(FRAMES + 1)[-1]
    view = view_of(FRAMES, T_cw, torch.rand(40, 3, generator=generator).double() + 4, generator)
    keyframe = submap.map.add_keyframe(view, T_cw)
    ids = submap.map.valid_points()[:10]
    submap.map.add_observations(keyframe, torch.arange(10), ids)
    count = len(submap.posed_frames)
    remove_keyframes(submap, torch.tensor([keyframe]))
    assert len(submap.posed_frames) == count + 1
    torch.testing.assert_close(submap.posed_frames.T_cw(submap.map)[-1], T_cw)
    assert int((submap.posed_frames.observations["frame_row"] == count).sum()) == 10


def test_the_reference_keyframe_of_tracking_cannot_be_removed(submap: Submap) -> None:
    with pytest.raises(ValueError, match="cannot be removed"):
        remove_keyframes(submap, torch.tensor([submap.tracking.reference]))


def test_the_tracking_state_drops_removed_rows(submap: Submap) -> None:
    renumbering = remove_keyframes(submap, GONE)
    assert submap.tracking.reference == renumbering.keyframes[6] == 4
    assert submap.tracking.local_keyframes.tolist() == [4, 3, 2, 1, 0]
    assert bool(submap.map.points["is_valid"][submap.tracking.local_points].all())


def thinned(submap: Submap) -> Submap:
    """Some points merged, some of these again, some dead."""
    submap.map.merge_points(torch.tensor([5, 6]), torch.tensor([2, 2]))
    submap.map.merge_points(torch.tensor([2]), torch.tensor([9]))
    submap.map.remove_points(torch.tensor([0, 11, 12]))
    return submap


def test_compaction_only_renumbers_points(submap: Submap) -> None:
    thinned(submap)
    before = copy.deepcopy(submap)
    rows = remove_invalid_rows(submap).points
    alive = before.map.points["is_valid"]
    assert len(submap.map.points) == submap.map.num_points == int(alive.sum())
    assert torch.equal(rows >= 0, alive)
    for name, column in submap.map.points.columns().items():
        assert torch.equal(column, before.map.points[name][alive]), name
    assert torch.equal(reprojection_errors(submap), reprojection_errors(before))
    old, new = (each.posed_frames.graph(each.map, SensorModel(CAMERA)) for each in (before, submap))
    for name in ("T_cw", "points_w", "frame_index", "point_index", "pixels", "weights", "keypoint_index"):
        assert torch.equal(getattr(new, name), getattr(old, name)), name
    assert torch.equal(new.point_ids, rows[old.point_ids])
    for name in ("local_points", "last_inlier_points"):
        held = getattr(before.tracking, name)
        assert torch.equal(getattr(submap.tracking, name), rows[held[alive[held]]]), name
    check(submap.map)


def test_rows_are_dropped_when_most_are_invalid(submap: Submap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compaction, "MIN_INVALID_ROWS", 10)
    count = len(submap.map.points)
    half = count // 2
    submap.map.remove_points(torch.arange(half))
    assert compact(submap) is None  # not more than half
    submap.map.remove_points(torch.tensor([half]))
    monkeypatch.setattr(compaction, "_MAX_REWRITTEN", len(submap.posed_frames.observations) / (half + 1))
    assert compact(submap) is None  # the history is too long for so few
    monkeypatch.setattr(compaction, "_MAX_REWRITTEN", 1 + len(submap.posed_frames.observations) / (half + 1))
    renumbering = compact(submap)
    assert renumbering is not None
    assert len(submap.map.points) == count - half - 1
