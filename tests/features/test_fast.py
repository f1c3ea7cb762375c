from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchslam.features import brief, fast
from torchslam.features import chunks as in_pieces
from torchslam.features.fast import CIRCLE, fast_scores, find_peaks, patch_scores


def noise(height: int, width: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


@given(st.integers(7, 30), st.integers(7, 30), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_scores_are_the_best_arc_of_nine(height: int, width: int, seed: int) -> None:
    image = noise(height, width, seed)
    scores = fast_scores(torch.from_numpy(image).flatten(), width).view(height, width).numpy()
    for y in range(3, height - 3):
        for x in range(3, width - 3):
            ring = [int(image[y + dy, x + dx]) - int(image[y, x]) for dx, dy in CIRCLE]
            arcs = [[ring[(start + k) % 16] for k in range(9)] for start in range(16)]
            expected = max(0, *(min(arc) for arc in arcs), *(-max(arc) for arc in arcs))
            assert scores[y, x] == expected


def test_pieces_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = torch.from_numpy(noise(40, 50, 3)).flatten()
    floor = torch.full_like(pixels, 10)
    scores, blurred = fast_scores(pixels, 50), brief.blur(pixels, 50)
    peaks = find_peaks(scores, floor, 50)
    assert 10 < len(peaks) < 500
    monkeypatch.setattr(in_pieces, "PIECE", 333)
    assert torch.equal(fast_scores(pixels, 50), scores)
    assert torch.equal(find_peaks(scores, floor, 50), peaks)
    assert torch.equal(brief.blur(pixels, 50), blurred)


@pytest.mark.parametrize("height", [12, 40])
def test_numpy_makes_no_difference(monkeypatch: pytest.MonkeyPatch, height: int) -> None:
    pixels, floor = torch.from_numpy(noise(height, 50, 4)).flatten(), torch.full((50 * height,), 10).byte()
    scores = fast_scores(pixels, 50)
    found = scores, find_peaks(scores, floor, 50), brief.blur(pixels, 50)
    for module in (fast, brief):
        monkeypatch.setattr(module, "on_host", lambda values: values)  # as on a GPU
    for expected, by_torch in zip(
        found, (fast_scores(pixels, 50), find_peaks(scores, floor, 50), brief.blur(pixels, 50)), strict=True
    ):
        assert expected.dtype == by_torch.dtype
        assert torch.equal(expected, by_torch)


@pytest.mark.parametrize("by_numpy", [True, False])
def test_bands_hold_what_they_hold_in_the_whole(monkeypatch: pytest.MonkeyPatch, by_numpy: bool) -> None:
    pixels, floor = torch.from_numpy(noise(40, 50, 5)).flatten(), torch.full((2000,), 255).byte()
    bands = ((0, 300), (500, 900), (1700, 2000))
    for start, stop in bands:
        floor[start:stop] = 10
    scores, peaks = fast_scores(pixels, 50), find_peaks(fast_scores(pixels, 50), floor, 50)
    if not by_numpy:
        monkeypatch.setattr(fast, "on_host", lambda values: values)
    monkeypatch.setattr(in_pieces, "PIECE", 333)
    found = fast_scores(pixels, 50, bands)
    assert all(torch.equal(found[start:stop], scores[start:stop]) for start, stop in bands)
    assert torch.equal(find_peaks(scores, floor, 50, bands), peaks)
    assert len(fast_scores(pixels, 50, ())) == 2000
    assert find_peaks(scores, floor, 50, ()).tolist() == []


def test_corners_are_those_of_opencv() -> None:
    image = cv2.GaussianBlur(noise(120, 160, 1), (0, 0), 1.5)
    detector = cv2.FastFeatureDetector.create(20, nonmaxSuppression=False)
    expected = {(round(p.pt[0]), round(p.pt[1])) for p in detector.detect(image)}
    scores = fast_scores(torch.from_numpy(image).flatten(), 160).view(120, 160)
    y, x = (scores[3:-3, 3:-3] > 20).nonzero().T + 3
    assert set(zip(x.tolist(), y.tolist(), strict=True)) == expected
    assert expected


def test_a_strip_too_thin_for_the_circle_has_no_corners() -> None:
    assert not fast_scores(torch.arange(60, dtype=torch.uint8), 10).any()
    nothing = find_peaks(torch.arange(20, dtype=torch.uint8), torch.zeros(20, dtype=torch.uint8), 10)
    assert nothing.tolist() == []


def test_patch_scores_are_the_scores_of_the_image() -> None:
    image = torch.from_numpy(noise(9, 9, 2))
    scores = fast_scores(image.flatten(), 9).view(9, 9)[3:6, 3:6]
    assert torch.equal(patch_scores(image[None].double())[0].clamp_min(0), scores.double())


def test_patch_scores_gradcheck() -> None:
    patches = torch.rand(2, 9, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(patch_scores, (patches.requires_grad_(),))


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_peaks_exceed_their_neighbours(seed: int) -> None:
    scores = torch.from_numpy(noise(12, 14, seed) // 64)  # many ties
    floor = torch.zeros(12 * 14, dtype=torch.uint8)
    peaks = torch.zeros(12, 14, dtype=torch.bool)
    peaks.view(-1)[find_peaks(scores.flatten(), floor, 14)] = True
    for y in range(1, 11):
        for x in range(1, 13):
            around = scores[y - 1 : y + 2, x - 1 : x + 2].flatten()
            before, after = around[:4], around[5:]
            best = bool(scores[y, x] > 0 and (scores[y, x] > before).all() and (scores[y, x] >= after).all())
            assert bool(peaks[y, x]) == best


def test_peaks_exceed_the_floor() -> None:
    scores = torch.zeros(9, 9, dtype=torch.uint8)
    scores[2, 2], scores[6, 6] = 10, 20
    peaks = find_peaks(scores.flatten(), torch.full((81,), 10, dtype=torch.uint8), 9)
    assert peaks.tolist() == [6 * 9 + 6]


@given(st.integers(0, 50), st.integers(0, 2000), st.integers(1, 400))
@settings(max_examples=50, deadline=None)
def test_pieces_make_up_the_whole(start: int, count: int, most: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(in_pieces, "PIECE", most)
        parts = in_pieces.pieces(np.zeros(0), start, start + count)
    assert [row for first, length in parts for row in range(first, first + length)] == list(
        range(start, start + count)
    )
    assert all(0 < length <= most for _, length in parts)
    assert len(parts) == -(-count // most)


def test_elsewhere_than_on_the_host_there_is_one_piece() -> None:
    assert in_pieces.pieces(torch.zeros(0), 3, 10**6) == [(3, 10**6 - 3)]
