"""Lean matching near predictions, against `match_projected`, which takes the long way."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchslam.features import match_projected
from torchslam.features.matching.by_projection import match_within
from torchslam.types import FrameFeatures


def view_of(count: int, seed: int, words: int = 8) -> FrameFeatures:
    """Keypoints all over, few distinct descriptors and scales: ties and rivals everywhere."""
    generator = torch.Generator().manual_seed(seed)
    codes = torch.randint(0, 256, (words, 32), generator=generator, dtype=torch.uint8)
    descriptors = codes[torch.randint(0, words, (count,), generator=generator)]
    flips = torch.randint(0, 2, (count, 32), generator=generator, dtype=torch.uint8)
    return FrameFeatures(
        0,
        0.0,
        keypoints=torch.rand(count, 2, generator=generator, dtype=torch.float64) * 200 - 5,
        scales=1.2 ** torch.randint(0, 4, (count,), generator=generator).double(),
        angles=torch.zeros(count, dtype=torch.float64),
        descriptors=descriptors ^ flips,
        mask=torch.rand(count, generator=generator) > 0.1,
    )


@pytest.mark.parametrize("ratio", [0.9, None])
@pytest.mark.parametrize("limit", [4, 64, 256])
@pytest.mark.parametrize("size", [2.0, 20.0, 300.0])
def test_it_finds_what_match_projected_finds(ratio: float | None, limit: int, size: float) -> None:
    found = 0
    for seed in range(5):
        expected, view = view_of(60, seed), view_of(80, seed + 100)
        view.descriptors[:60] = expected.descriptors ^ (torch.arange(32) == 3).to(torch.uint8)
        view.keypoints[:60] = expected.keypoints + 1.0
        radius = size * (0.5 + torch.arange(60).double() / 60)
        wanted = match_projected(
            expected.descriptors[None],
            expected.keypoints[None],
            radius[None],
            view.features,
            mask=expected.mask[None],
            scales=expected.scales[None],
            ratio=ratio,
            max_distance=limit,
        )
        rows, columns, distances = match_within(expected, view, radius, ratio, limit)
        mask = wanted.mask[0]
        assert torch.equal(rows, wanted.indices_1[0][mask])
        assert torch.equal(columns, wanted.indices_2[0][mask])
        assert torch.equal(distances, wanted.distances[0][mask])
        found += len(rows)
    assert found > 0


@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (5, 0), (0, 0)])
def test_nothing_matches_nothing(rows: int, columns: int) -> None:
    first, second, _ = match_within(view_of(rows, 0), view_of(columns, 1), torch.ones(rows).double(), 0.9, 64)
    assert len(first) == len(second) == 0
    assert first.dtype == torch.int64


def test_no_keypoint_in_any_window() -> None:
    view = view_of(20, 0)
    elsewhere = replace(view, keypoints=view.keypoints + 500)
    rows, *_ = match_within(view, elsewhere, torch.full((20,), 9.0).double(), 0.9, 64)
    assert len(rows) == 0
