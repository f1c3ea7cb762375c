"""The index from points to keyframes says what a scan of the whole table says, whatever was done to the map."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchslam.map.map import NO_POINT, Map
from torchslam.map.observation_index import ObservationIndex, first_of_each, top_rows
from torchslam.types import FrameFeatures

KEYPOINTS, DESCRIPTOR = 6, 4
Change = tuple[str, int, list[int]]

CHANGES = st.lists(
    st.tuples(
        st.sampled_from(["keyframe", "points", "observe", "forget", "invalidate", "replace", "append"]),
        st.integers(0, 10_000),
        st.lists(st.integers(0, 10_000), min_size=1, max_size=5),
    ),
    max_size=25,
)


def add_keyframe(slam_map: Map) -> int:
    zeros = torch.zeros(KEYPOINTS, dtype=torch.float64)
    scales = 1.0 + torch.arange(KEYPOINTS, dtype=torch.float64) + slam_map.num_keyframes
    descriptors = torch.zeros(KEYPOINTS, DESCRIPTOR, dtype=torch.uint8)
    mask = torch.ones(KEYPOINTS, dtype=torch.bool)
    view = FrameFeatures(
        slam_map.num_keyframes, 0.0, torch.zeros(KEYPOINTS, 2).double(), scales, zeros, descriptors, mask
    )
    return slam_map.add_keyframe(view, torch.eye(4, dtype=torch.float64))


def add_points(slam_map: Map, count: int) -> Tensor:
    descriptors = torch.zeros(count, DESCRIPTOR, dtype=torch.uint8)
    return slam_map.add_points(torch.zeros(count, 3, dtype=torch.float64), descriptors, keyframe=0)


def make_map(keyframes: int = 2, points: int = 4) -> Map:
    slam_map = Map()
    for _ in range(keyframes):
        add_keyframe(slam_map)
    add_points(slam_map, points)
    return slam_map


def change_map(slam_map: Map, change: Change) -> None:
    """One change that the interface allows; which one exactly is up to the numbers."""
    kind, number, numbers = change
    table = slam_map.keyframes["point_ids"]
    living = slam_map.valid_points()
    keyframe = number % slam_map.num_keyframes
    if kind == "keyframe":
        add_keyframe(slam_map)
    elif kind == "points":
        add_points(slam_map, len(numbers) * 20)
    elif kind == "observe":
        free = torch.nonzero(table[keyframe] == NO_POINT)[:, 0]
        fresh = living[~torch.isin(living, table[keyframe])]
        fresh = fresh[torch.unique(torch.tensor(numbers) % len(fresh))] if len(fresh) else fresh
        count = min(len(free), len(fresh))
        slam_map.add_observations(keyframe, free[:count], fresh[:count])
    elif kind == "forget":
        rows, columns = torch.nonzero(table >= 0, as_tuple=True)
        if len(rows):
            which = torch.unique(torch.tensor(numbers) % len(rows))
            slam_map.remove_observations(rows[which], columns[which])
    elif kind == "invalidate" and len(living):
        slam_map.remove_points(torch.unique(living[torch.tensor(numbers) % len(living)]))
    elif kind == "replace" and len(living) > 1:
        chosen = torch.unique(living[torch.tensor(numbers) % len(living)])
        replacement = living[~torch.isin(living, chosen)]
        if len(replacement):
            slam_map.merge_points(
                chosen, replacement[torch.arange(len(chosen)) * (number + 1) % len(replacement)]
            )
    elif kind == "append" and len(slam_map.points) < 200:
        other = make_map(2, 3)
        other.add_observations(1, torch.tensor([0, 4]), torch.tensor([2, 0]))
        slam_map.append(other)


def scanned(slam_map: Map, point_ids: Tensor) -> Tensor:
    """(K, N) bool: where the table holds one of the points."""
    return torch.isin(slam_map.keyframes["point_ids"], point_ids)


def check(slam_map: Map) -> None:
    table, points = slam_map.keyframes["point_ids"], slam_map.points
    ids = torch.arange(len(points))
    counts = torch.bincount(table[table >= 0], minlength=len(points))
    assert torch.equal(points["times_observed"], counts)
    for row in table:
        assert len(torch.unique(row[row >= 0])) == int((row >= 0).sum())
    assert not bool(((table >= 0) & ~points["is_valid"][table]).any())
    some = ids[::3]
    assert torch.equal(slam_map.count_observed(some), scanned(slam_map, some).sum(1))
    few = torch.arange(slam_map.num_keyframes).flip(0)[:2]
    assert torch.equal(slam_map.count_observed(some, few), scanned(slam_map, some).sum(1)[few])
    for keyframe in range(slam_map.num_keyframes):
        seen = table[keyframe]
        shared = scanned(slam_map, seen[seen >= 0]).sum(1)
        shared[keyframe] = 0
        order = torch.sort(shared, descending=True, stable=True)
        expected = order.indices[:3][order.values[:3] >= 1]
        assert torch.equal(slam_map.covisible_keyframes(keyframe, 3, min_shared=1), expected)
    keyframes, scales = slam_map.observers_and_scales(ids)
    for point in ids.tolist():
        rows, columns = torch.nonzero(table == point, as_tuple=True)
        held = keyframes[point] >= 0
        assert torch.equal(torch.sort(keyframes[point][held]).values, rows)
        own = dict(zip(keyframes[point][held].tolist(), scales[point][held].tolist(), strict=True))
        assert [own[k] for k in rows.tolist()] == slam_map.keyframes["scales"][rows, columns].tolist()


@settings(deadline=None, max_examples=60)
@given(CHANGES)
def test_the_index_agrees_with_a_scan_of_the_table(changes: list[Change]) -> None:
    slam_map = make_map()
    for change in changes:
        change_map(slam_map, change)
        table = slam_map.keyframes["point_ids"]
        counts = torch.bincount(table[table >= 0], minlength=len(slam_map.points))
        assert torch.equal(slam_map.points["times_observed"], counts)
    check(slam_map)


def replaced_by_scan(table: Tensor, old: Tensor, new: Tensor, points: int) -> Tensor:
    """The table after a merge, row by row: the replacement's own keypoint stays, else the first."""
    table = table.clone()
    replacement = dict(zip(old.tolist(), new.tolist(), strict=True))
    for row in table:
        seen = set(row[row >= 0].tolist()) - replacement.keys()
        for keypoint, point in enumerate(row.tolist()):
            if point in replacement:
                row[keypoint] = NO_POINT if replacement[point] in seen else replacement[point]
                seen.add(replacement[point])
    return table


@settings(deadline=None, max_examples=60)
@given(CHANGES, st.lists(st.integers(0, 2), min_size=1, max_size=6))
def test_merging_agrees_with_a_scan_of_the_table(changes: list[Change], replacement: list[int]) -> None:
    slam_map = make_map(points=12)
    for change in changes:
        change_map(slam_map, change)
    living = slam_map.valid_points()
    if len(living) < 3 + len(replacement):
        return
    old, new = living[3 : 3 + len(replacement)], living[torch.tensor(replacement)]
    before = slam_map.keyframes["point_ids"].clone()
    slam_map.merge_points(old, new)
    expected = replaced_by_scan(before, old, new, len(slam_map.points))
    assert torch.equal(slam_map.keyframes["point_ids"], expected)
    check(slam_map)


@given(st.lists(st.integers(0, 5), max_size=20), st.integers(1, 6), st.integers(1, 4))
def test_the_most_frequent_equal_those_of_a_full_sort(counts: list[int], limit: int, least: int) -> None:
    values = torch.tensor(counts, dtype=torch.int64)
    order = torch.sort(values, descending=True, stable=True)
    expected = order.indices[:limit][order.values[:limit] >= least]
    assert torch.equal(top_rows(values, limit, least), expected)


@pytest.mark.parametrize("values", [[], [3], [3, 1, 3, 3, 1, 2]])
def test_the_first_observation_of_each_point(values: list[int]) -> None:
    expected = [value not in values[:place] for place, value in enumerate(values)]
    assert first_of_each(torch.tensor(values, dtype=torch.int64)).tolist() == expected


def test_an_index_grown_in_inference_mode_can_be_changed_outside() -> None:
    with torch.inference_mode():
        index = ObservationIndex(torch.full((1, 4), -1))
        index.add(torch.arange(200), torch.arange(200))
    index.remove(torch.tensor([7]), torch.tensor([7]))
    index.clear(torch.tensor([8]))
    assert index.observations_of(torch.tensor([6, 7, 8]))[1].tolist() == [6]
    with torch.inference_mode():
        assert index.observations_of(torch.tensor([1000]))[1].tolist() == []  # a point without observations
    index.add(torch.tensor([1000]), torch.tensor([9]))
    assert index.observations_of(torch.tensor([1000]))[1].tolist() == [9]
