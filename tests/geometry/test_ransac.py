import math

import pytest
import torch

from torchslam.geometry.lie import cayley_rotation, so3_exp
from torchslam.geometry.ransac import (
    is_significant,
    is_unlikely,
    levenberg_marquardt,
    pad_groups,
    sample_minimal,
    sample_minimal_of_all,
    samples_needed,
    search,
    truncated_score,
)


def test_samples_are_distinct_rows_of_the_mask_and_repeatable() -> None:
    mask = (
        torch.rand(3, 40, generator=torch.Generator().manual_seed(0)) < torch.tensor((0.9, 0.5, 0.2))[:, None]
    )
    sample, again = (sample_minimal(mask, 5, 100, torch.Generator().manual_seed(1)) for _ in range(2))
    assert torch.equal(sample, again)
    assert sample.shape == (3, 100, 5)
    for rows, allowed in zip(sample, mask, strict=True):
        assert allowed[rows].all()
        assert all(len(set(row)) == 5 for row in rows.tolist())
        assert set(rows.flatten().tolist()) == set(allowed.nonzero().flatten().tolist())


@pytest.mark.parametrize("rows", [3, 4, 40])
def test_samples_of_all_rows_equal_those_of_a_full_mask(rows: int) -> None:
    mask = torch.ones(1, rows, dtype=torch.bool)
    masked = sample_minimal(mask, 3, 25, torch.Generator().manual_seed(1))[0]
    assert torch.equal(sample_minimal_of_all(rows, 3, 25, torch.Generator().manual_seed(1)), masked)


@pytest.mark.parametrize("available", [0, 1, 2])
def test_too_few_rows_repeat(available: int) -> None:
    mask = torch.arange(6)[None] < available
    sample = sample_minimal(mask, 3, 10, torch.Generator().manual_seed(0))
    assert sample.shape == (1, 10, 3)
    assert int(sample.max()) < 6


def test_samples_needed() -> None:
    needed = samples_needed(torch.tensor((50, 100, 0)), torch.tensor((100, 100, 0)), 3, 0.99)
    assert float(needed[0]) == pytest.approx(math.log(0.01) / math.log(1 - 0.125))
    assert float(needed[1]) < 1
    assert float(needed[2]) > 1e6


def test_a_round_doubles_or_draws_the_number_that_the_inlier_ratio_needs() -> None:
    """34.5 samples of three have one without outliers with 99 %, where half of the rows are."""

    def rounds(as_needed: bool, first: int) -> list[int]:
        counts = []

        def propose(rows: torch.Tensor, count: int) -> tuple[tuple[torch.Tensor], torch.Tensor, torch.Tensor]:
            counts.append(count)
            return (torch.zeros(len(rows)),), torch.full((len(rows),), len(counts)), torch.tensor([50])

        (model,) = search(propose, torch.tensor([100]), 3, 0.99, first, 1000, as_needed)
        assert model.shape == (1,)
        return counts

    assert rounds(False, 8) == [8, 16, 32]
    assert rounds(True, 8) == [8, 16, 11]
    assert rounds(True, 30) == [30, 30]  # not less than the first one
    assert rounds(True, 40) == [40]


def test_truncated_score_ignores_masked_rows_and_nan() -> None:
    squared = torch.tensor((((0.0, 0.5, 2.0, torch.nan, 0.0),),))
    mask = torch.tensor(((True, True, True, True, False),))
    assert truncated_score(squared, mask).item() == pytest.approx(1.5)


def test_significance_is_the_published_number_of_false_alarms() -> None:
    """Of 100 rows, samples of 5 with 10 solutions: (n - s) solutions C(n, k) C(k, s) p^(k - s), below 0.001."""
    for chance in (0.01, 0.1, 0.3):
        alarms = [950 * math.comb(100, k) * math.comb(k, 5) * chance ** (k - 5) for k in range(101)]
        expected = [k > 5 and alarms[k] < 1e-3 for k in range(101)]
        found = is_significant(
            torch.arange(101), torch.full((101,), 100), 5, torch.full((101,), chance).double(), 10
        )
        assert found.tolist() == expected
        assert any(expected)


def test_pad_groups() -> None:
    values = torch.arange(5.0)[:, None]
    padded, valid = pad_groups(values, torch.tensor((0, 0, 2, 2, 2)), 3, least=2)
    assert padded.squeeze(-1).tolist() == [[0, 1, 0], [0, 0, 0], [2, 3, 4]]
    assert valid.tolist() == [[True, True, False], [False] * 3, [True] * 3]


def test_minimize_reaches_the_minimum_of_each_problem_and_survives_nan() -> None:
    target = torch.tensor((2.0, 8.0, torch.nan), dtype=torch.float64)

    def evaluate(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        residual, J = x.pow(3) - target[:, None], 3 * x.square()
        rows = torch.stack((J, residual), dim=-1)
        return rows.mT @ rows, residual.squeeze(-1).square()

    (x,), cost = levenberg_marquardt(
        (torch.ones(3, 1, dtype=torch.float64),), evaluate, lambda x, step: (x[0] + step,), 60
    )
    torch.testing.assert_close(x[:2, 0], torch.tensor((2 ** (1 / 3), 2.0), dtype=torch.float64))
    assert float(cost[:2].max()) < 1e-10
    assert float(x[2]) == 1.0


def test_cayley_rotation_is_a_rotation_close_to_exp() -> None:
    omega = 0.01 * torch.randn(10, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    R = cayley_rotation(omega)
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=R.dtype).expand(10, 3, 3))
    torch.testing.assert_close(R, so3_exp(omega), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("count", "expected"), [(4, False), (8, False), (12, True), (30, True)])
def test_unlikely_supports_are_significant(count: int, expected: bool) -> None:
    """Of 30 rows of a chance of 0.05 each, two of which make the sample."""
    found = is_unlikely(torch.tensor([count]), torch.tensor([30]), 2, torch.tensor([0.05]))
    assert found.tolist() == [expected]


def test_false_alarms_bound_the_binomial_tail() -> None:
    for count in range(5, 30):
        tail = sum(math.comb(28, k) * 0.2**k * 0.8 ** (28 - k) for k in range(count - 2, 29))
        alarms = 435 * tail
        if is_unlikely(torch.tensor([count]), torch.tensor([30]), 2, torch.tensor([0.2])).item():
            assert alarms < 0.1
        elif alarms < 0.01:
            pytest.fail(f"{count} of 30 are expected {alarms:.4f} times")
