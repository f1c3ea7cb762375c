"""Positions of cameras from pairs: the lengths of their baselines, and differences along edges in general."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.global_mapping.synthetic import CAMERA, Recording, arc, ball, line, rand, randn, wall
from torchslam.evaluation import ate
from torchslam.geometry import rigid, se3_inverse
from torchslam.global_mapping.baselines import ViewRays, chained_positions, pair_lengths, solve_differences
from torchslam.global_mapping.view_graph import Relation, ViewPair

WALK = Recording.of(line(10), wall(200, 2.3))
TURN = Recording.of(arc(12, 120.0, 2.5), ball(60))


def error(recording: Recording, pairs: list[ViewPair]) -> float:
    """How far positions are from true ones up to a similarity, by the true rotations."""
    R_cw = recording.T_cw[:, :3, :3]
    centers_w = chained_positions(pairs, R_cw, recording.views, CAMERA)
    T_cw = rigid(R_cw, -(R_cw @ centers_w[..., None])[..., 0])
    return float(ate(T_cw=T_cw, T_cw_groundtruth=recording.T_cw))


def baselines(recording: Recording, pairs: list[ViewPair]) -> Tensor:
    centers = se3_inverse(recording.T_cw)[:, :3, 3]
    return torch.stack([(centers[pair.second] - centers[pair.first]).norm() for pair in pairs])


def shuffled(pair: ViewPair) -> ViewPair:
    """A wrong pair: its direction is any, its depths are those of other matches."""
    T_21 = pair.T_21.clone()
    T_21[:3, 3] = torch.nn.functional.normalize(randn(pair.first, 3), dim=0)
    return replace(pair, T_21=T_21, keypoints_2=pair.keypoints_2.roll(1))


# --- positions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recording", [WALK, TURN])
def test_exact_pairs_give_the_positions(recording: Recording) -> None:
    assert error(recording, recording.pairs(1, 2, 3)) < 1e-4
    assert error(recording, recording.pairs(1)) < 1e-4


def test_wrong_pairs_are_outvoted() -> None:
    pairs = TURN.pairs(1, 2, 3, 5)
    wrong = rand(8, len(pairs)) < 0.2
    given = [
        shuffled(pair) if is_wrong else pair for pair, is_wrong in zip(pairs, wrong.tolist(), strict=True)
    ]
    assert int(wrong.sum()) > 5
    assert error(TURN, given) < 0.03


def test_pairs_of_a_camera_that_only_turns_do_not_count() -> None:
    """They may say anything; without others all cameras are at one place."""
    pairs = TURN.pairs(1, 2, 3)
    others = [replace(shuffled(pair), relation=Relation.ROTATION) for pair in [*pairs, *pairs]]
    assert error(TURN, [*others, *pairs]) < 1e-4
    centers_w = chained_positions(others, TURN.T_cw[:, :3, :3], TURN.views, CAMERA)
    assert torch.equal(centers_w, torch.zeros(12, 3, dtype=torch.float64))
    assert chained_positions([], TURN.T_cw[:, :3, :3], TURN.views, CAMERA).shape == (12, 3)


def plane(pair: ViewPair) -> ViewPair:
    """The same matches with any direction, of either sign."""
    T_21 = pair.T_21.clone()
    T_21[:3, 3] = torch.nn.functional.normalize(randn(pair.first, 3), dim=0)
    return replace(pair, T_21=T_21, relation=Relation.PLANE)


@pytest.mark.parametrize("recording", [WALK, TURN])
def test_the_rotations_of_all_images_give_pairs_of_a_plane_their_direction(recording: Recording) -> None:
    assert error(recording, [plane(pair) for pair in recording.pairs(1, 2, 3)]) < 1e-4


def test_wrong_matches_of_a_plane_lose_their_weight() -> None:
    pairs = []
    for pair in WALK.pairs(1, 2, 3):
        matches = pair.keypoints_2.clone()
        matches[:2] = matches[:2].flip(0)
        pairs.append(replace(plane(pair), keypoints_2=matches))
    assert error(WALK, pairs) < 1e-3


def test_images_without_pairs_have_finite_positions() -> None:
    pairs = [pair for pair in TURN.pairs(1, 2) if 11 not in (pair.first, pair.second)]
    centers_w = chained_positions(pairs, TURN.T_cw[:, :3, :3], TURN.views, CAMERA)
    assert bool(torch.isfinite(centers_w).all())
    cut = replace(TURN, T_cw=TURN.T_cw[:11], views=TURN.views[:11], shows=TURN.shows[:11])
    assert error(cut, pairs) < 1e-4


# --- lengths ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recording", [WALK, TURN])
def test_lengths_of_pairs_are_those_of_their_baselines(recording: Recording) -> None:
    """In a common unit, whichever images the pairs share."""
    pairs = recording.pairs(1, 2, 3)
    ratio = pair_lengths(pairs, ViewRays(CAMERA, recording.views)) / baselines(recording, pairs)
    torch.testing.assert_close(ratio, ratio.mean().expand_as(ratio), rtol=1e-5, atol=0)


def test_pairs_that_nothing_ties_to_others_have_the_length_one() -> None:
    pairs = [WALK.pair(0, 1), WALK.pair(1, 3), WALK.pair(5, 6), WALK.pair(7, 9)]
    lengths = pair_lengths(pairs, ViewRays(CAMERA, WALK.views)).tolist()
    assert lengths[2:] == [1, 1]
    assert lengths[1] / lengths[0] == pytest.approx(2, rel=1e-4)
    assert pair_lengths(pairs[2:], ViewRays(CAMERA, WALK.views)).tolist() == [1, 1]


# --- differences -----------------------------------------------------------------------------------------------


@given(st.integers(0, 1000), st.integers(2, 12), st.integers(1, 3))
@settings(max_examples=25, deadline=None)
def test_exact_differences_are_solved(seed: int, nodes: int, columns: int) -> None:
    """In any direction of the edges, several between the same nodes; what is common to all stays open."""
    true = randn(seed, nodes, columns)
    chain = torch.stack([torch.arange(nodes - 1), torch.arange(1, nodes)], 1)
    more = (rand(seed + 1, 10, 2) * nodes).long()
    edges = torch.cat([chain, more[more[:, 0] != more[:, 1]]])
    edges = torch.where(rand(seed + 2, len(edges), 1) < 0.5, edges, edges.flip(1))
    stds = 0.1 + rand(seed + 3, len(edges))
    found = solve_differences(edges, true[edges[:, 1]] - true[edges[:, 0]], stds, nodes)
    torch.testing.assert_close(found - found[:1], true - true[:1], atol=1e-5, rtol=0)


def test_differences_are_weighted_by_their_errors() -> None:
    """Two of the same nodes, 0 and 1, the second twice as precise: it has four of five votes, far within the kernel."""
    edges = torch.tensor([[0, 1], [0, 1]])
    differences = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    stds = torch.tensor([100.0, 50.0], dtype=torch.float64)
    found = solve_differences(edges, differences, stds, 2)
    assert float(found[1] - found[0]) == pytest.approx(0.8, rel=1e-3)
    assert float(found.sum()) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("columns", [1, 2])
def test_the_kernel_is_that_of_cauchy_of_three_errors(columns: int) -> None:
    """Of the length of an error, at the minimum its pulls cancel: by differences that are ten apart in each column."""
    edges = torch.tensor([[0, 1], [0, 1]])
    differences = torch.tensor([[0.0], [10.0]], dtype=torch.float64).expand(2, columns)
    stds = torch.tensor([1.0, 0.5], dtype=torch.float64)
    found = solve_differences(edges, differences, stds, 2)
    x = float(found[1, 0] - found[0, 0])
    torch.testing.assert_close(found[1] - found[0], torch.full((columns,), x).double())
    pulls = [
        (x - difference) / std**2 / (1 + columns * ((x - difference) / std) ** 2 / 9)
        for difference, std in ((0, 1.0), (10, 0.5))
    ]
    assert sum(pulls) == pytest.approx(0, abs=1e-3)
    assert 9 < x < 10


def test_parts_that_nothing_connects_are_solved_each() -> None:
    edges = torch.tensor([[0, 1], [3, 4], [4, 5]])
    differences = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
    found = solve_differences(edges, differences, torch.ones(3, dtype=torch.float64), 7)[:, 0]
    torch.testing.assert_close(
        found, torch.tensor([-0.5, 0.5, 0, -7 / 3, -1 / 3, 8 / 3, 0]).double(), atol=1e-4, rtol=0
    )
    nothing = solve_differences(
        torch.zeros(0, 2, dtype=torch.int64), differences[:0], torch.zeros(0).double(), 3
    )
    assert nothing.tolist() == [[0], [0], [0]]
