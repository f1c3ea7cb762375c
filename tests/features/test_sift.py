from __future__ import annotations

import math
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from tests.features.test_orb import distances, same, scene, to_tensor
from torchslam.features import SIFT, match
from torchslam.features.contract import check_features
from torchslam.features.opencv import LEAST_SIZE, LOCALIZATION, RUN_NOISE
from torchslam.types import Features


def blobs(*stds: float, center: tuple[float, float] = (80.3, 59.6), width: int = 160) -> Tensor:
    """Gaussian blobs of these standard deviations side by side in one image, at the same place of each part."""
    x, y = torch.arange(width), torch.arange(120)[:, None]
    squared = (x - center[0]) ** 2 + (y - center[1]) ** 2
    return torch.cat([0.2 + 0.6 * (-squared / (2 * std**2)).exp() for std in stds], dim=1)[None, None]


def matched(first: Features, second: Features) -> tuple[Tensor, Tensor]:
    """Rows of the matches of two images."""
    found = match(first, second, ratio=0.8, max_distance=0.25)
    return found.indices_1[0][found.mask[0]], found.indices_2[0][found.mask[0]]


def apply_homography(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    mapped = np.c_[points, np.ones(len(points))] @ H.T
    return mapped[:, :2] / mapped[:, 2:]


def test_the_center_of_a_blob_is_found_to_a_twentieth_of_a_pixel() -> None:
    for std in (1.5, 3.0, 6.0):
        features = SIFT(50)(blobs(std))
        strongest = features.keypoints[0, 0]
        torch.testing.assert_close(strongest, torch.tensor([80.3, 59.6]), atol=0.05, rtol=0)


def test_the_scale_grows_with_the_blob() -> None:
    features = SIFT(50)(blobs(4.0, 8.0))
    found = features.keypoints[0][features.mask[0]]
    left, right = (int(distances(found, torch.tensor([[x, 59.6]])).argmin()) for x in (80.3, 240.3))
    ratio = features.scales[0, right] / features.scales[0, left]
    assert float(ratio) == pytest.approx(2, rel=0.05)
    # The difference of Gaussians of sigma and 2^(1/3) sigma is largest where their geometric mean is the blob's.
    assert float(features.scales[0, left]) == pytest.approx(4.0 / 2 ** (1 / 6) / 1.6, rel=0.05)


def test_fields_have_the_documented_shapes(dtype: torch.dtype) -> None:
    images = scene(200, 260).to(dtype).expand(2, 1, -1, -1)
    features = SIFT(150)(images)
    check_features(features, images, "SIFT")
    assert features.keypoints.shape == (2, 150, 2)
    assert features.descriptors.shape == (2, 150, 128)
    assert features.mask.all()
    for name, values in vars(features).items():
        assert values.dtype == (torch.bool if name == "mask" else dtype), name
        assert values.isfinite().all()
    assert (features.keypoints >= 0).all()
    assert (features.keypoints <= torch.tensor([259, 199])).all()
    assert features.scales.min() == 1
    assert features.angles.abs().max() <= math.pi + 1e-6
    lengths = features.descriptors.norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths), atol=1e-6, rtol=0)


def test_results_are_on_the_device_of_the_images(device: torch.device) -> None:
    image = scene(100, 120)
    mask = torch.ones_like(image, dtype=torch.bool)
    expected, found = SIFT(30)(image), SIFT(30).to(device)(image.to(device), mask.to(device))
    assert all(values.device.type == device.type for values in vars(found).values())
    assert same(expected, found.to("cpu"))


def test_the_strongest_come_first_and_ties_are_in_order_of_place() -> None:
    features = SIFT(400)(scene(200, 260, 1))
    rows = torch.stack((-features.scores, *features.keypoints.unbind(-1)), dim=-1)[features.mask].tolist()
    assert rows == sorted(rows)
    assert len(rows) > len({tuple(row) for row in rows}) > 100  # one place has several orientations
    weaker = SIFT(90)(scene(200, 260, 1))
    for name, values in vars(features).items():
        assert torch.equal(getattr(weaker, name), values[:, :90])


def test_the_same_images_give_the_same_bytes_with_any_number_of_threads() -> None:
    images = torch.cat([scene(150, 170, seed) for seed in range(2)] + [torch.zeros(1, 1, 150, 170)])
    extract = SIFT(120)
    batch = extract(images)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1 if threads > 1 else 2)
    again = pickle.loads(pickle.dumps(extract))(images)
    cv2.setNumThreads(threads)
    assert same(batch, again)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="num_keypoints >= 1"):
        SIFT(0)


@pytest.mark.parametrize("axis", [2, 3])
def test_keypoints_of_the_flipped_image_are_flipped_without_bias(axis: int) -> None:
    image = scene(240, 321, 3)
    first, second = SIFT(600)(image), SIFT(600)(image.flip(axis))
    keypoints, flipped = first.keypoints[first.mask], second.keypoints[second.mask]
    along = 3 - axis
    flipped[:, along] = image.shape[axis] - 1 - flipped[:, along]
    apart = distances(keypoints, flipped)
    near = apart.amin(1) < 0.5
    assert near.double().mean() > 0.95
    error = (flipped[apart.argmin(1)] - keypoints)[near][:, along]
    assert abs(float(error.median())) < 1e-3
    assert abs(float(error.mean())) < 5e-3


def test_localization_on_a_warped_image_is_as_stated(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of real images, two half-size renderings with noise of two gray values, at the contrast it was measured with."""
    monkeypatch.setattr("torchslam.features.opencv.CONTRAST_THRESHOLD", 0.02)
    rng, errors = np.random.default_rng(0), []
    for name in ("garden", "machine_hall", "redkitchen"):
        path = min((data_dir / name / "rgb").iterdir())
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        size = image.shape[1] // 2, image.shape[0] // 2
        half = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
        center = np.array([[1, 0, size[0] / 2], [0, 1, size[1] / 2], [0, 0, 1.0]])
        turn = np.array([[0.98, -0.17, 2.3], [0.17, 0.98, -1.6], [2e-4, -1e-4, 1]])
        H = center @ turn @ np.linalg.inv(center)
        views = [
            to_tensor(np.clip(warped(image, M, size) + rng.normal(0, 2, size[::-1]), 0, 255))
            for M in (half, H @ half)
        ]
        first, second = (SIFT(2000)(view.float()) for view in views)
        i, j = matched(first, second)
        at = first.keypoints[0][i].double().numpy()
        expected = apply_homography(H, at)
        growth = np.linalg.norm(apply_homography(H, at + np.array([1, 0])) - expected, axis=1)
        assert first.information is not None
        assert second.information is not None
        noise = np.hypot(
            growth * first.information[0][i].numpy() ** -0.5, second.information[0][j].numpy() ** -0.5
        )
        found = (second.keypoints[0][j].numpy() - expected) / noise[:, None]
        errors.append(found[np.abs(found).max(1) < 5])  # the others are wrong matches
    squared = np.square(np.concatenate(errors)).sum(1)
    assert len(squared) > 500
    assert abs(np.concatenate(errors).mean(0)).max() < 0.05
    # By the 95 % quantile of chi square: errors have longer tails than a Gaussian, and gates are there.
    assert math.sqrt(np.quantile(squared, 0.95) / 5.991) * RUN_NOISE == pytest.approx(1, rel=0.2)


def warped(image: np.ndarray, H: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An image under a homography, averaged over nine samples of each pixel."""
    finer = np.array([[3, 0, 1], [0, 3, 1], [0, 0, 1.0]])
    fine = cv2.warpPerspective(
        image.astype(np.float32),
        finer @ H,
        (3 * size[0], 3 * size[1]),
        flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT,
    )
    return cv2.resize(fine, size, interpolation=cv2.INTER_AREA)


def test_information_is_the_inverse_variance_of_the_size() -> None:
    features = SIFT(50)(blobs(2.0, 12.0))
    assert features.information is not None
    deviations = features.information[features.mask] ** -0.5
    sizes = 3.2 * features.scales[features.mask]
    torch.testing.assert_close(deviations, RUN_NOISE * LOCALIZATION * sizes.clamp_min(LEAST_SIZE))
    assert float(deviations.max()) > 1.5 * float(deviations.min())
