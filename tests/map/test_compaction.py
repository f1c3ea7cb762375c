"""A world without some of its keyframes and points says of the others what it said before."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from tests.map.simulated import CAMERA, path, reprojection_errors, simulated_world, view_of
from tests.map.test_observation_index import check
from torchslam.map import compaction
from torchslam.map.compaction import compact, drop_dead_points, remove_keyframes
from torchslam.map.posed_frames import RunGraph
from torchslam.map.submap import Submap

GONE = torch.tensor([1, 3])
FRAMES = 20


@pytest.fixture
def world() -> Submap:
    """Seven keyframes, the last one the track's reference."""
    return simulated_world(frames=FRAMES)


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


def test_no_frame_moves_when_keyframes_go(world: Submap) -> None:
    before = copy.deepcopy(world)
    remove_keyframes(world, GONE)
    torch.testing.assert_close(world.history.T_cw(world.map), before.history.T_cw(before.map))
    torch.testing.assert_close(world.T_cw, before.T_cw)
    trajectory = world.trajectory()
    assert torch.equal(trajectory.timestamps, before.trajectory().timestamps)
    assert int(world.history.frames["reference_keyframe"].max()) < world.map.num_keyframes == 5


def test_the_other_keyframes_see_what_they_saw(world: Submap) -> None:
    before = copy.deepcopy(world)
    renumbering = remove_keyframes(world, GONE)
    assert renumbering.keyframes.tolist() == [0, -1, 1, -1, 2, 3, 4]
    stays = renumbering.keyframes >= 0
    for name, column in world.map.keyframes.columns().items():
        if name != "point_ids":
            assert torch.equal(column, before.map.keyframes[name][stays]), name
    old, new = before.map.keyframes["point_ids"][stays], world.map.keyframes["point_ids"]
    alive = world.map.points["is_valid"]
    assert torch.equal(torch.where((old >= 0) & alive[old], old, -1), new)
    assert not bool((alive & (world.map.points["times_observed"] < 2)).any())
    check(world.map)


def test_the_heir_of_a_keyframe_is_near_it_and_stays(world: Submap) -> None:
    heirs = remove_keyframes(world, GONE).heirs
    assert heirs.tolist()[::2] == [0, 1, 2, 4]
    assert heirs[1] in (0, 1)  # old rows 0 and 2, its neighbours on the way
    assert heirs[3] in (1, 2)


def test_points_are_left_to_a_keyframe_that_sees_them(world: Submap) -> None:
    made_by_gone = torch.isin(world.map.points["first_keyframe"], GONE)
    assert int(made_by_gone.sum()) > 0
    remove_keyframes(world, GONE)
    points = world.map.points
    table = world.map.keyframes["point_ids"]
    for point in torch.nonzero(points["is_valid"] & made_by_gone)[:, 0].tolist():
        assert int(torch.nonzero((table == point).any(1))[0]) == points["first_keyframe"][point]
    assert int(points["first_keyframe"].max()) < world.map.num_keyframes


def test_the_graph_keeps_what_removed_keyframes_saw_last(world: Submap) -> None:
    """Not what their frames were tracked with: a dropped observation stays dropped, a new one stays."""
    keyframe = int(GONE[1])
    seen = torch.nonzero(world.map.keyframes["point_ids"][keyframe] >= 0)[:, 0]
    world.map.forget(GONE[1:], seen[:1])
    first = world.map.keyframes["point_ids"][keyframe]
    free, others = torch.nonzero(first < 0)[1:2, 0], world.map.points_seen_by(torch.tensor([2]))
    world.map.observe(keyframe, free, others[~torch.isin(others, first)][:1])
    before = copy.deepcopy(world)
    remove_keyframes(world, GONE)
    old, new = before.history.graph(before.map, CAMERA), world.history.graph(world.map, CAMERA)
    assert int(new.is_keyframe.sum()) == int(old.is_keyframe.sum()) - 2
    assert sorted(new.frame_ids.tolist()) == sorted(old.frame_ids.tolist())
    torch.testing.assert_close(by_frame(new), by_frame(old))
    frame = int(before.map.keyframes["frame_index"][keyframe])
    assert (frame, int(seen[0])) not in pairs(new)
    assert (frame, int(free[0])) in pairs(new)
    dead = before.map.points["is_valid"] & ~world.map.points["is_valid"]
    gone_points = before.map.positions_w[dead].tolist()
    expected = {key: where for key, where in seen_points(old).items() if where not in gone_points}
    assert seen_points(new) == expected
    assert all(pairs(old)[key] == pixel for key, pixel in pairs(new).items())


@pytest.mark.parametrize("forgotten", [0, 5])
def test_the_history_of_the_other_frames_is_untouched(world: Submap, forgotten: int) -> None:
    keypoints = torch.nonzero(world.map.keyframes["point_ids"][3] >= 0)[:forgotten, 0]
    world.map.forget(torch.full_like(keypoints, 3), keypoints)
    before = copy.deepcopy(world.history)
    own = torch.isin(before.observations["frame_row"], 3 * GONE)  # every third frame is a keyframe
    remove_keyframes(world, GONE)
    kept = ~torch.isin(world.history.observations["frame_row"], 3 * GONE)
    for name, column in world.history.observations.columns().items():
        assert torch.equal(column[kept], before.observations[name][~own]), name
    assert int((~kept).sum()) == int(own.sum()) - forgotten


def test_a_keyframe_whose_frame_was_never_added_becomes_a_frame(world: Submap) -> None:
    generator = torch.Generator().manual_seed(5)
    T_cw = path(FRAMES + 1)[-1]
    view = view_of(FRAMES, T_cw, torch.rand(40, 3, generator=generator).double() + 4, generator)
    keyframe = world.map.add_keyframe(view, T_cw)
    ids = world.map.valid_points()[:10]
    world.map.observe(keyframe, torch.arange(10), ids)
    count = len(world.history)
    remove_keyframes(world, torch.tensor([keyframe]))
    assert len(world.history) == count + 1
    torch.testing.assert_close(world.history.T_cw(world.map)[-1], T_cw)
    assert int((world.history.observations["frame_row"] == count).sum()) == 10


def test_what_holds_the_world_cannot_go(world: Submap) -> None:
    for keyframe in (0, world.track.reference):
        with pytest.raises(ValueError, match="cannot be removed"):
            remove_keyframes(world, torch.tensor([keyframe]))


def test_the_track_forgets_what_is_gone(world: Submap) -> None:
    renumbering = remove_keyframes(world, GONE)
    assert world.track.reference == renumbering.keyframes[6] == 4
    assert world.track.local_keyframes.tolist() == [4, 3, 2, 1, 0]
    assert bool(world.map.points["is_valid"][world.track.local_points].all())


def thinned(world: Submap) -> Submap:
    """Some points merged, some of these again, some dead."""
    world.map.replace(torch.tensor([5, 6]), torch.tensor([2, 2]))
    world.map.replace(torch.tensor([2]), torch.tensor([9]))
    world.map.invalidate(torch.tensor([0, 11, 12]))
    return world


def test_dropping_dead_points_changes_nothing_but_their_numbers(world: Submap) -> None:
    thinned(world)
    before = copy.deepcopy(world)
    rows = drop_dead_points(world).points
    alive = before.map.points["is_valid"]
    assert len(world.map.points) == world.map.num_points == int(alive.sum())
    assert torch.equal(rows >= 0, alive)
    for name, column in world.map.points.columns().items():
        assert torch.equal(column, before.map.points[name][alive]), name
    assert torch.equal(reprojection_errors(world), reprojection_errors(before))
    old, new = before.history.graph(before.map, CAMERA), world.history.graph(world.map, CAMERA)
    for name in ("T_cw", "points_w", "frame_index", "point_index", "pixels", "weights", "keypoint_index"):
        assert torch.equal(getattr(new, name), getattr(old, name)), name
    assert torch.equal(new.point_ids, rows[old.point_ids])
    for name in ("local_points", "seen_last"):
        held = getattr(before.track, name)
        assert torch.equal(getattr(world.track, name), rows[held[alive[held]]]), name
    check(world.map)


def test_a_merged_point_is_seen_as_its_heir_afterwards(world: Submap) -> None:
    merged = torch.isin(world.history.observations["point_ids"], torch.tensor([2, 5, 6, 9]))
    count = int(merged.sum())
    rows = drop_dead_points(thinned(world)).points
    assert int((world.history.observations["point_ids"] == rows[9]).sum()) == count


def test_a_compacted_world_goes_on(world: Submap) -> None:
    drop_dead_points(thinned(world))
    remove_keyframes(world, GONE)
    ids = world.map.add_points(
        torch.zeros(2, 3, dtype=torch.float64), torch.zeros(2, 32, dtype=torch.uint8), 0
    )
    assert ids.tolist() == [len(world.map.points) - 2, len(world.map.points) - 1]
    free = torch.nonzero(world.map.keyframes["point_ids"][4] < 0)[:2, 0]
    world.map.observe(4, free, ids)
    check(world.map)


def test_rows_are_dropped_when_most_of_them_are_dead(world: Submap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compaction, "LEAST_DEAD", 10)
    count = len(world.map.points)
    half = count // 2
    world.map.invalidate(torch.arange(half))
    assert compact(world) is None  # not more than half
    world.map.invalidate(torch.tensor([half]))
    monkeypatch.setattr(compaction, "_PRICE", len(world.history.observations) / (half + 1))
    assert compact(world) is None  # the history is too long for so few
    monkeypatch.setattr(compaction, "_PRICE", 1 + len(world.history.observations) / (half + 1))
    renumbering = compact(world)
    assert renumbering is not None
    assert len(world.map.points) == count - half - 1
