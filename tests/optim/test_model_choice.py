"""The choice between two explanations: known values, symmetry, few stretches, and errors of decisions by chance."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from torch import Tensor

from torchslam.optim.model_choice import LEAST_GAIN, LEAST_UPDATE, STRETCHES, Gain, predictive_gain


def sums(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_the_total_has_the_scatter_of_its_stretches() -> None:
    """Of n stretches with a sample deviation of s, the sum has s sqrt(n)."""
    found = Gain.of_stretches(sums(1.0, 2.0, 3.0, 6.0))
    assert (found.total, found.stretches) == (12.0, 4)
    assert found.std == pytest.approx(2 * sums(1.0, 2.0, 3.0, 6.0).std())
    assert found.std == pytest.approx(math.sqrt(4 / 3 * 14))


def test_one_stretch_has_no_scatter() -> None:
    for values in ((), (5.0,)):
        found = Gain.of_stretches(sums(*values))
        assert (found.total, found.std, found.sigmas) == (sum(values), math.inf, 0.0)
        assert not found.is_sure


@pytest.mark.parametrize("stretches", [3, 5, 10, 20])
@pytest.mark.parametrize("t", [0.5, 2.0, 4.0, 8.0])
def test_sigmas_are_as_improbable_as_the_t_statistic(t: float, stretches: int) -> None:
    """Within what the bound of Wallace is off, which is 3 % from two degrees of freedom on."""
    expected = stats.norm.isf(stats.t.sf(t, stretches - 1))
    assert Gain(t, 1.0, stretches).sigmas == pytest.approx(expected, rel=0.03)


def test_two_stretches_that_agree_within_a_third_are_not_sure() -> None:
    assert not Gain.of_stretches(sums(30.0, 60.0)).is_sure
    assert Gain.of_stretches(sums(*[30.0, 60.0] * 5)).is_sure


def test_a_given_model_is_harder_to_replace_than_an_estimate() -> None:
    for total, of_given, of_estimate in (
        (LEAST_GAIN + 1, True, True),
        (LEAST_GAIN - 1, False, True),
        (LEAST_UPDATE - 1, False, False),
        (-LEAST_GAIN - 1, False, False),
    ):
        found = Gain(total, 1e-3, 10)
        assert (found.is_worth(), found.is_worth(is_given=False)) == (of_given, of_estimate)


numbers = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=60)


@given(numbers)
def test_the_other_way_around_the_gain_is_the_opposite(differences: list[float]) -> None:
    first, when = sums(*differences), torch.arange(len(differences))
    zero = torch.zeros_like(first)
    one, other = predictive_gain(first, zero, when), predictive_gain(zero, first, when)
    assert one.total == pytest.approx(-other.total, abs=1e-9)
    assert one.std == pytest.approx(other.std)
    assert one.sigmas == pytest.approx(-other.sigmas, abs=1e-9)
    assert one.total == pytest.approx(float(first.sum()), abs=1e-6)
    assert not (one.is_sure and other.is_sure)
    assert predictive_gain(first, first, when).sigmas == 0.0


def test_stretches_are_those_of_time() -> None:
    """Errors that last as long as a stretch: in the order of time they disagree, shuffled they seem to agree."""
    when = torch.arange(200)
    waves = 1.0 + 6.0 * torch.sin(2 * math.pi * when / 60).double()
    zero = torch.zeros_like(waves)
    found = predictive_gain(waves, zero, when)
    assert found.stretches == STRETCHES
    expected = Gain.of_stretches(waves.view(STRETCHES, -1).sum(1))
    assert (found.total, found.std) == pytest.approx((expected.total, expected.std))
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    mixed = predictive_gain(waves[order], zero, when[order])
    assert mixed.total == pytest.approx(found.total)
    assert mixed.std == pytest.approx(found.std)
    assert predictive_gain(waves[order], zero, when).std < 0.6 * found.std


@pytest.mark.parametrize(("count", "stretches"), [(0, 1), (1, 1), (2, 2), (7, 7), (13, 10)])
def test_few_observations_are_a_stretch_each(count: int, stretches: int) -> None:
    found = predictive_gain(torch.ones(count), torch.zeros(count), torch.zeros(count))
    assert (found.total, found.stretches) == (count, stretches)
    assert math.isfinite(found.std) == (stretches > 1)


def test_equal_explanations_are_rarely_told_apart() -> None:
    """Heavy-tailed noise of 3000 recordings: a normal distribution has 0.13 % above three deviations."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(3000, 50, generator=generator, dtype=torch.float64)
    noise = noise * torch.rand(3000, 50, generator=generator, dtype=torch.float64).clamp_min(0.05) ** -0.5
    gains = [predictive_gain(each, torch.zeros(50), torch.arange(50)) for each in noise]
    assert 0 <= sum(gain.is_sure for gain in gains) <= 12
    sigmas = torch.tensor([gain.sigmas for gain in gains])
    assert float(sigmas.std()) == pytest.approx(1.0, abs=0.1)


def test_a_better_explanation_of_all_stretches_is_sure() -> None:
    noise = torch.randn(100, 200, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gains = [predictive_gain(each + 0.5, torch.zeros(200), torch.arange(200)) for each in noise]
    assert sum(gain.is_sure for gain in gains) > 95


def test_one_stretch_that_is_much_better_is_not_sure() -> None:
    """As a turn in which everything happens: what a second recording would show is unknown."""
    gains = torch.zeros(100, dtype=torch.float64)
    gains[40:50] = 50.0
    assert not predictive_gain(gains, 0 * gains, torch.arange(100)).is_sure
