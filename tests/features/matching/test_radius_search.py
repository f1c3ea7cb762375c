"""Keypoints within a radius, and the nearest of pairs, on the CPU and elsewhere."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.features.matching.random_features import features
from torchslam.features import expand_runs
from torchslam.features.matching.by_projection import nearest_of_pairs, pairs_within_radius


@given(
    seed=st.integers(0, 1000),
    batch=st.integers(1, 3),
    spread=st.sampled_from([1.0, 20.0, 1e5]),
    largest=st.sampled_from([0.0, 25.0, 400.0]),
)
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)  # of the fixture nothing is kept
def test_pairs_within_a_radius_equal_brute_force(
    device: torch.device, seed: int, batch: int, spread: float, largest: float
) -> None:
    """Wherever keypoints are, in front of the first cell and behind the last one too."""
    first, second = features(batch, 60, seed), features(batch, 70, seed + 1)
    places, keypoints = ((view.keypoints.double() - 100) * spread + 100 for view in (first, second))
    keypoints[:, :20] = places[:, :20]  # within a radius of nothing
    radius = largest * torch.rand(batch, 60, generator=torch.Generator().manual_seed(seed)).double()
    inputs = (places, radius, first.mask, keypoints, second.mask)
    row, column = (found.cpu() for found in pairs_within_radius(*(tensor.to(device) for tensor in inputs)))
    squared = (places[:, :, None] - keypoints[:, None]).square().sum(-1)
    near = (squared <= radius.square()[..., None]) & first.mask[..., None] & second.mask[:, None]
    b, i, j = near.nonzero(as_tuple=True)
    assert (row.diff() >= 0).all()
    assert sorted(zip(row.tolist(), column.tolist(), strict=True)) == list(
        zip((b * 60 + i).tolist(), (b * 70 + j).tolist(), strict=True)
    )


@given(
    seed=st.integers(0, 1000), ratio=st.sampled_from([None, 0.5, 0.9]), pairs=st.sampled_from([0, 1, 40, 400])
)
@settings(max_examples=60, deadline=None)
def test_the_nearest_of_the_pairs_is_found(seed: int, ratio: float | None, pairs: int) -> None:
    """As one finds it pair by pair, with many ties."""
    generator = torch.Generator().manual_seed(seed)
    key = torch.randperm(30 * 20, generator=generator)[:pairs].sort().values
    row, column = key // 20, key % 20
    distance = torch.randint(0, 12, (len(key),), generator=generator)
    scales = 1.2 ** torch.randint(0, 3, (20,), generator=generator).double()
    wanted: dict[int, tuple[int, int, int]] = {}
    for i in range(30):
        of_row = sorted((int(d), int(c)) for r, c, d in zip(row, column, distance, strict=True) if r == i)
        if not of_row or of_row[0][0] > 9:
            continue
        nearest, chosen = of_row[0]
        others = [d for d, c in of_row[1:] if scales[c] == scales[chosen]]
        if ratio is not None and others and not nearest < ratio * min(others):
            continue
        wanted[chosen] = min(wanted.get(chosen, (99, 0, 0)), (nearest, i, chosen))
    expected = sorted((i, c, d) for d, i, c in wanted.values())
    inputs = (tensor.numpy() for tensor in (row, column, distance))
    found, distances, mask = nearest_of_pairs(*inputs, 30, scales.numpy(), ratio, 9)
    rows = np.flatnonzero(mask)
    assert list(zip(rows, found[mask], distances[mask], strict=True)) == expected
    assert not found[~mask].any()
    assert not distances[~mask].any()


def test_runs_are_expanded(device: torch.device) -> None:
    run, number = expand_runs(torch.tensor([3, 7, 0], device=device), torch.tensor([5, 7, 3], device=device))
    assert run.tolist() == [0, 0, 2, 2, 2]
    assert number.tolist() == [3, 4, 0, 1, 2]
