"""FAST corners, Harris responses and sub-pixel positions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchslam.features import corners, orb
from torchslam.features.corners import (
    FAST_CIRCLE,
    fast_scores,
    find_peaks,
    gather_patches,
    harris_responses,
    patch_scores,
    quadratic_peak,
    soft_peak,
)


def noise(height: int, width: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


@given(st.integers(7, 30), st.integers(7, 30), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_scores_are_the_best_arc_of_nine(height: int, width: int, seed: int) -> None:
    image = noise(height, width, seed)
    scores = fast_scores(torch.from_numpy(image).flatten(), width).view(height, width).numpy()
    for y in range(3, height - 3):
        for x in range(3, width - 3):
            ring = [int(image[y + dy, x + dx]) - int(image[y, x]) for dx, dy in FAST_CIRCLE]
            arcs = [[ring[(start + k) % 16] for k in range(9)] for start in range(16)]
            expected = max(0, *(min(arc) for arc in arcs), *(-max(arc) for arc in arcs))
            assert scores[y, x] == expected


def test_chunking_does_not_change_the_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = torch.from_numpy(noise(40, 50, 3)).flatten()
    floor = torch.full_like(pixels, 10)
    scores, blurred = fast_scores(pixels, 50), orb.blur(pixels, 50)
    peaks = find_peaks(scores, floor, 50)
    assert 10 < len(peaks) < 500
    monkeypatch.setattr(corners, "CHUNK_PIXELS", 333)
    assert torch.equal(fast_scores(pixels, 50), scores)
    assert torch.equal(find_peaks(scores, floor, 50), peaks)
    assert torch.equal(orb.blur(pixels, 50), blurred)


@pytest.mark.parametrize("height", [12, 40])
def test_the_numpy_backend_gives_the_same_scores(monkeypatch: pytest.MonkeyPatch, height: int) -> None:
    pixels, floor = torch.from_numpy(noise(height, 50, 4)).flatten(), torch.full((50 * height,), 10).byte()
    scores = fast_scores(pixels, 50)
    found = scores, find_peaks(scores, floor, 50), orb.blur(pixels, 50)
    for module in (corners, orb):
        monkeypatch.setattr(module, "to_numpy", lambda values: values)  # as on a GPU
    elsewhere = fast_scores(pixels, 50), find_peaks(scores, floor, 50), orb.blur(pixels, 50)
    for expected, by_torch in zip(found, elsewhere, strict=True):
        assert expected.dtype == by_torch.dtype
        assert torch.equal(expected, by_torch)


@pytest.mark.parametrize("by_numpy", [True, False])
def test_scores_in_bands_equal_those_of_the_whole_image(
    monkeypatch: pytest.MonkeyPatch, by_numpy: bool
) -> None:
    pixels, floor = torch.from_numpy(noise(40, 50, 5)).flatten(), torch.full((2000,), 255).byte()
    bands = ((0, 300), (500, 900), (1700, 2000))
    for start, stop in bands:
        floor[start:stop] = 10
    scores, peaks = fast_scores(pixels, 50), find_peaks(fast_scores(pixels, 50), floor, 50)
    if not by_numpy:
        monkeypatch.setattr(corners, "to_numpy", lambda values: values)
    monkeypatch.setattr(corners, "CHUNK_PIXELS", 333)
    found = fast_scores(pixels, 50, bands)
    assert all(torch.equal(found[start:stop], scores[start:stop]) for start, stop in bands)
    assert torch.equal(find_peaks(scores, floor, 50, bands), peaks)
    assert len(fast_scores(pixels, 50, ())) == 2000
    assert find_peaks(scores, floor, 50, ()).tolist() == []


def test_corners_agree_with_opencv() -> None:
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


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_peaks_exceed_their_neighbors(seed: int) -> None:
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


@given(st.integers(0, 50), st.integers(0, 2000), st.integers(1, 400))
@settings(max_examples=50, deadline=None)
def test_chunks_cover_the_image(start: int, count: int, most: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(corners, "CHUNK_PIXELS", most)
        parts = corners.chunks(np.zeros(0), start, start + count)
    assert [row for first, length in parts for row in range(first, first + length)] == list(
        range(start, start + count)
    )
    assert all(0 < length <= most for _, length in parts)
    assert len(parts) == -(-count // most)


def paraboloid(x: float, y: float, side: int = 3) -> torch.Tensor:
    """A peak at (x, y) from the center, turned and longer in one direction than in the other."""
    axis = torch.arange(side, dtype=torch.float64) - side // 2
    dy, dx = torch.meshgrid(axis - y, axis - x, indexing="ij")
    return 100 - 3 * dx**2 - 2 * dy**2 + dx * dy


def test_patches_are_cut_around_their_positions() -> None:
    image = torch.arange(100).view(10, 10)
    patches = gather_patches(image.flatten(), torch.tensor([44, 55]), 10, 2)
    assert torch.equal(patches[0], image[2:7, 2:7])
    assert torch.equal(patches[1], image[3:8, 3:8])


def test_harris_agrees_with_opencv() -> None:
    image = np.random.default_rng(0).integers(0, 256, (11, 11), dtype=np.uint8)
    expected = cv2.cornerHarris(image.astype(np.float32), 7, 3, 0.04)[4:7, 4:7]
    ours = harris_responses(torch.from_numpy(image)[None].double())[0]
    # OpenCV divides the derivatives by 4 and sums by 7.
    np.testing.assert_allclose(ours.numpy() / (4 * 7) ** 4, expected, rtol=1e-4)


def test_harris_gradcheck() -> None:
    patches = torch.rand(2, 10, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(harris_responses, (patches.requires_grad_(),))


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.3, -0.2), (-0.45, 0.4)])
def test_quadratic_peak_of_a_paraboloid(x: float, y: float) -> None:
    torch.testing.assert_close(
        quadratic_peak(paraboloid(x, y)[None]), torch.tensor([[x, y]], dtype=torch.float64)
    )


@pytest.mark.parametrize(
    "responses", [torch.zeros(1, 3, 3), torch.ones(1, 3, 3), -paraboloid(0.2, 0.2)[None]]
)
def test_without_a_peak_there_is_no_offset(responses: torch.Tensor) -> None:
    assert not quadratic_peak(responses).any()


def test_quadratic_peak_is_limited() -> None:
    assert quadratic_peak(paraboloid(2.0, 0.0)[None]).abs().max() <= 0.5


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.4, -0.3)])
def test_soft_peak_leans_towards_the_maximum(x: float, y: float) -> None:
    offset = soft_peak(paraboloid(x, y, 5)[None])[0]
    assert (offset - torch.tensor([x, y])).abs().max() < 0.25
    assert torch.equal(offset.sign(), torch.tensor([x, y], dtype=torch.float64).sign()) or x == 0
