"""Matching near predicted pixels, against a plain loop."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.features.matching.random_features import distances_between, disturbed, features, pairs
from torchslam.features import match_by_projection
from torchslam.types import Features


def naive_projected(
    query: Features,
    pixels: Tensor,
    radius: Tensor,
    second: Features,
    row: int,
    ratio: float,
    limit: float,
    guided: bool,
) -> dict[int, int]:
    d = distances_between(query, second)[row]
    apart = (second.keypoints[row] - pixels[row, :, None]).norm(dim=-1)
    factors = (second.scales[row] / query.scales[row, :, None]).tolist()
    turns = (second.angles[row] - query.angles[row, :, None] + math.pi) % (2 * math.pi) - math.pi
    is_near, turned, scales = (
        (apart <= radius[row, :, None]).tolist(),
        turns.tolist(),
        second.scales[row].tolist(),
    )
    masks = query.mask[row].tolist(), second.mask[row].tolist()
    claims: dict[int, tuple[float, int]] = {}
    for i in range(d.shape[0]):
        if not masks[0][i]:
            continue
        candidates = []
        for j in range(d.shape[1]):
            fits = not guided or (1 / 1.3 <= factors[i][j] <= 1.3 and abs(turned[i][j]) <= 0.5)
            if masks[1][j] and is_near[i][j] and fits:
                candidates.append((float(d[i, j]), j))
        if not candidates:
            continue
        nearest, j = min(candidates)
        same_scale = [c for c, k in candidates if k != j and scales[k] == scales[j]]
        good = nearest <= limit and nearest < ratio * min(same_scale, default=math.inf)
        if good and (nearest, i) < claims.get(j, (math.inf, -1)):
            claims[j] = (nearest, i)
    return {i: j for j, (_, i) in claims.items()}


@pytest.mark.parametrize("floats", [None, 16])
@pytest.mark.parametrize("guided", [True, False])
@given(seed=st.integers(0, 1000), size=st.sampled_from([5.0, 40.0, 400.0]))
@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_match_by_projection_equals_the_loop(
    device: torch.device, floats: int | None, guided: bool, seed: int, size: float
) -> None:
    query = features(2, 25, seed, floats)
    second = disturbed(query, seed + 1)
    g = torch.Generator().manual_seed(seed + 2)
    pixels = query.keypoints + torch.randn(2, 25, 2, generator=g) * 4
    pixels[0, 0], pixels[1, 0], pixels[1, 1] = -1e4, 1e30, math.nan
    radius = size * torch.rand(2, 25, generator=g)
    limit = 60 if floats is None else 0.3
    extras = {"scales": query.scales.to(device), "angles": query.angles.to(device)} if guided else {}
    given = (tensor.to(device) for tensor in (query.descriptors, pixels, radius, second, query.mask))
    matches = match_by_projection(
        *given, ratio=0.9, max_distance=limit, scale_tolerance=1.3, angle_tolerance=0.5, **extras
    )
    for row in range(2):
        assert pairs(matches, row) == naive_projected(query, pixels, radius, second, row, 0.9, limit, guided)


def test_match_by_projection_with_one_radius_and_no_limits() -> None:
    first = features(1, 30, 9)
    matches = match_by_projection(
        first.descriptors, first.keypoints, 1e-3, first, first.mask, ratio=None, max_distance=None
    )
    valid = first.mask[0].nonzero()[:, 0].tolist()
    assert pairs(matches) == {i: i for i in valid}


@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (5, 0), (0, 0)])
def test_match_by_projection_of_empty_sets(rows: int, columns: int) -> None:
    query = features(1, rows)
    matches = match_by_projection(query.descriptors, query.keypoints, 10.0, features(1, columns))
    assert matches.mask.shape == (1, rows)
    assert not matches.mask.any()


def test_match_by_projection_with_empty_windows() -> None:
    first = features(1, 10)
    matches = match_by_projection(first.descriptors, first.keypoints + 1000, 5.0, first)
    assert not matches.mask.any()
    assert matches.distances.isfinite().all()


def test_match_by_projection_distances_carry_gradients() -> None:
    base = features(1, 8, 11, 5)

    def distances(a: Tensor, b: Tensor) -> Tensor:
        found = match_by_projection(
            a, base.keypoints, 50.0, replace(base, descriptors=b), base.mask, max_distance=None
        )
        return found.distances

    a, b = (base.descriptors.double().clone().requires_grad_() for _ in range(2))
    assert torch.autograd.gradcheck(distances, (a, b))
