"""Depths of the matches of a pair, and the ratio of those of two pairs, where both are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.global_mapping.synthetic import CAMERA, Recording, arc, ball, line, wall
from torchslam.geometry import se3_inverse, transform
from torchslam.global_mapping.baselines import PairDepths, ViewRays, depth_ratio
from torchslam.global_mapping.view_graph import ViewPair

WALK = Recording.of(line(4, 0.4), wall(200, 1.2))


def depths_of(recording: Recording, pair: ViewPair, scale: float = 1.0) -> PairDepths:
    """The depths by the true relative pose, its translation longer by a factor."""
    T_21 = recording.T_cw[pair.second] @ se3_inverse(recording.T_cw[pair.first])
    T_21[:3, 3] *= scale
    return PairDepths.of(T_21, ViewRays(CAMERA, recording.views), pair)


def distances(recording: Recording, row: int) -> Tensor:
    """Of the point of each keypoint of an image from its camera."""
    return transform(recording.T_cw[row], recording.points_w[recording.shows[row]]).norm(dim=-1)


@pytest.mark.parametrize("recording", [WALK, Recording.of(arc(4, 60.0), ball(100))])
def test_inverse_depths_are_those_of_the_points(recording: Recording) -> None:
    """As seen from either image, where there is a match."""
    pair = recording.pair(1, 3)
    depths = depths_of(recording, pair)
    for row, keypoints, inverse, sigma in zip(
        (1, 3), (pair.keypoints_1, pair.keypoints_2), depths.inverse, depths.sigma, strict=True
    ):
        assert set(np.flatnonzero(~np.isnan(inverse))) == set(keypoints.tolist())
        np.testing.assert_array_equal(np.isnan(inverse), np.isnan(sigma))
        np.testing.assert_allclose(
            inverse[keypoints], 1 / distances(recording, row)[keypoints].numpy(), rtol=1e-9
        )


def test_the_noise_is_that_of_the_disparity() -> None:
    """0.7 pixels of it: 0.4 to the side at a depth of four, before the other camera, are 40 pixels."""
    points_w = torch.tensor([[0.4, 0.0, 4.0], [0.4, 0.0, 2.0]], dtype=torch.float64)
    recording = Recording.of(line(2, 0.4), points_w)
    depths = depths_of(recording, recording.pair(0, 1))
    inverse, sigma = (columns[0][recording.at(0)] for columns in (depths.inverse, depths.sigma))
    # Along the ray of the other image, the baseline is seen from the side.
    np.testing.assert_allclose(sigma, 0.7 / 400 / 0.4, rtol=1e-9)
    np.testing.assert_allclose(sigma[0] / inverse[0], 0.7 / 40, rtol=0.01)
    longer = depths_of(recording, recording.pair(0, 1), 2.0)
    np.testing.assert_allclose(longer.inverse, np.array(depths.inverse) / 2)
    np.testing.assert_allclose(longer.sigma, np.array(depths.sigma) / 2)


def test_points_behind_have_negative_depths_and_a_turn_has_none() -> None:
    """Without a baseline inverse depths are zero and infinitely uncertain, not NaN."""
    pair = WALK.pair(0, 1)
    behind = depths_of(WALK, pair, -1.0)
    assert bool((behind.inverse[0][pair.keypoints_1] < 0).all())
    turn = depths_of(WALK, pair, 0.0)
    assert turn.inverse[0][pair.keypoints_1].tolist() == [0.0] * len(pair)
    assert bool((turn.sigma[0][pair.keypoints_1] > 1e9).all())
    assert depth_ratio(turn, 0, depths_of(WALK, WALK.pair(0, 2)), 0) is None


@pytest.mark.parametrize(
    ("ends", "at", "others", "other_at"),
    [((0, 1), 1, (1, 2), 0), ((0, 1), 0, (0, 2), 0), ((0, 2), 1, (1, 2), 1), ((1, 2), 0, (0, 1), 1)],
)
def test_the_ratio_is_that_of_the_units(
    ends: tuple[int, int], at: int, others: tuple[int, int], other_at: int
) -> None:
    """Whichever image two pairs share: with a baseline that is called three times as long, depths are, too."""
    one, other = depths_of(WALK, WALK.pair(*ends), 3.0), depths_of(WALK, WALK.pair(*others), 1.0)
    found, back = depth_ratio(one, at, other, other_at), depth_ratio(other, other_at, one, at)
    assert found is not None
    assert back is not None
    assert found.log_ratio == pytest.approx(math.log(3))
    assert back.log_ratio == pytest.approx(-math.log(3))
    assert found.std < 1e-9


def depths(inverse: Tensor, sigma: float = 0.01) -> PairDepths:
    """Of keypoints that two images have in the same order."""
    table = inverse.double().numpy()
    return PairDepths((table, table), (np.full_like(table, sigma), np.full_like(table, sigma)))


@pytest.mark.parametrize(("count", "told"), [(11, False), (12, True)])
def test_twelve_common_keypoints_are_needed(count: int, told: bool) -> None:
    one, other = torch.ones(30), torch.ones(30)
    one[:9], other[9 + count :] = torch.nan, torch.nan
    assert (depth_ratio(depths(one), 0, depths(other), 0) is not None) == told


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize(("inverse", "told"), [(5 * 0.01, False), (0.0501, True), (-1.0, False)])
def test_the_parallax_must_be_five_times_its_noise_in_both_pairs(
    inverse: float, told: bool, side: int
) -> None:
    columns = [torch.ones(12, dtype=torch.float64) for _ in range(2)]
    columns[side][0] = inverse
    assert (depth_ratio(depths(columns[0]), 0, depths(columns[1]), 0) is not None) == told


def test_the_ratio_is_a_median_with_its_error() -> None:
    """Of keypoints with parallax in both: eight say 0.4 and eight 0.6, and what has no parallax does not count."""
    logarithm = torch.tensor([0.4, 0.6] * 8)
    one, other = torch.ones(40), torch.cat([logarithm.exp(), torch.full((24,), 0.02)])
    found = depth_ratio(depths(one), 0, depths(other), 0)
    assert found is not None
    assert found.log_ratio == pytest.approx(0.5)
    assert found.std == pytest.approx(1.2533 * 1.4826 * 0.1 / 4, rel=1e-4)
    # One that is wrong by far changes little.
    other[0] = 1e6
    robust = depth_ratio(depths(one), 0, depths(other), 0)
    assert robust is not None
    assert robust.log_ratio == pytest.approx(0.6)
    assert robust.std < 0.05
