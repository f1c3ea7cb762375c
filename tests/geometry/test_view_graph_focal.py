"""The focal length that makes essential matrices of the fundamental matrices of many pairs."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from geometry_scenes import CAMERA, many_views
from torch import Tensor

from torchslam.data import open_sequence
from torchslam.geometry import Camera, essential_from_pose, skew, so3_exp
from torchslam.geometry.view_graph_focal import ViewGraphFocal, focal_from_fundamentals, focal_from_pairs

FOCAL, SIZE = 525.0, (640, 480)
CENTER = CAMERA.params[2:]
K = torch.tensor(((FOCAL, 0.0, 319.5), (0.0, FOCAL, 239.5), (0.0, 0.0, 1.0)), dtype=torch.float64)
BENT = Camera.radial_tangential(FOCAL, FOCAL, 319.5, 239.5, 0.04, 0.0, 0.0, 0.0, size=SIZE)

Matches = tuple[Tensor, Tensor, Tensor, Tensor]


def matrix_of(T_21: Tensor) -> Tensor:
    """F, for pixels."""
    inverse = torch.linalg.inv(K)
    return inverse.mT @ essential_from_pose(T_21[:, :3, :3], T_21[:, :3, 3]) @ inverse


def pairs(
    count: int = 20, noise: float = 0.5, matches: int = 200, plane: bool = False, camera: Camera = CAMERA
) -> Matches:
    """The true F, matching pixels and their mask of pairs of views of a scene of its own each."""
    scene = many_views(
        range(100, 100 + count), count=matches, outliers=0.0, noise=noise, plane=plane, camera=camera
    )
    return matrix_of(scene.T_21), scene.pixels_1, scene.pixels_2, scene.mask


def moving(omega: Tensor, t: Tensor, noise: float = 0.5, seed: int = 0) -> Matches:
    """As `pairs`, with given motions: rotation vectors and translations (M, 3), of a scene between 2 and 8 away."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    M, N = len(omega), 300
    pixels_1, depth = random(M, N, 2) * torch.tensor(SIZE), 2 + 6 * random(M, N, 1)
    points = CAMERA.unproject(pixels_1)
    R = so3_exp(omega)
    points_2 = (points / points[..., 2:] * depth) @ R.mT + t[:, None]
    pixels_2, valid = CAMERA.project(points_2)
    mask = valid & CAMERA.in_image(pixels_2)
    pixels_1, pixels_2 = (
        pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
        for pixels in (pixels_1, pixels_2)
    )
    # A rotating camera has no direction; that of its matrix is arbitrary.
    t = torch.where((t == 0).all(-1, keepdim=True), random(M, 3) - 0.5, t)
    inverse = torch.linalg.inv(K)
    return inverse.mT @ skew(t) @ R @ inverse, pixels_1, pixels_2, mask


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# From pixels from the principal point in widths, in which F is of order one, to pixels.
TO_PIXELS = torch.tensor(((640.0, 0.0, 319.5), (0.0, 640.0, 239.5), (0.0, 0.0, 1.0)), dtype=torch.float64)


def scaled(F: Tensor) -> Tensor:
    F = TO_PIXELS.mT @ F @ TO_PIXELS
    return F / F.flatten(1).norm(dim=1)[:, None, None]


def in_pixels(F: Tensor) -> Tensor:
    back = torch.linalg.inv(TO_PIXELS)
    return back.mT @ F @ back


def disturbed(F: Tensor, size: float, seed: int = 0) -> Tensor:
    """Rank two, with errors relative to the norm in scaled coordinates."""
    U, S, Vh = torch.linalg.svd(scaled(F) + size * normal(*F.shape, seed=seed))
    return in_pixels((U[..., :2] * S[:, None, :2]) @ Vh[:, :2])


def off(found: ViewGraphFocal) -> float:
    """The error, relative to the truth."""
    return abs(float(found.focal) / FOCAL - 1)


def test_exact_pairs_give_the_focal_length() -> None:
    matches = pairs(noise=0.0)
    for found in (
        focal_from_fundamentals(matches[0], CENTER, SIZE),
        focal_from_pairs(*matches, CENTER, SIZE),
        focal_from_pairs(*matches, CENTER, SIZE, k1_std=0.0),
    ):
        assert off(found) < 1e-6
        assert found.success
        assert found.inliers.all()
        assert found.errors.max() < 1e-4
        assert abs(float(found.k1)) < 1e-6


@pytest.mark.parametrize("focal", [200.0, 420.0, 640.0, 2000.0])
def test_any_focal_length_of_the_range_is_found(focal: float) -> None:
    T_21 = many_views(range(10)).T_21
    inverse = torch.linalg.inv(torch.cat((K[:, :2] * focal / FOCAL, K[:, 2:]), 1))
    F = inverse.mT @ essential_from_pose(T_21[:, :3, :3], T_21[:, :3, 3]) @ inverse
    assert float(focal_from_fundamentals(F, CENTER, SIZE).focal) == pytest.approx(focal, rel=1e-6)


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_noise(noise: float) -> None:
    matches = pairs(noise=noise)
    found = focal_from_pairs(*matches, CENTER, SIZE)
    assert found.success
    assert off(found) < min(0.02, 3 * float(found.std))
    assert found.inliers.sum() >= 18
    exactly = focal_from_pairs(*matches, CENTER, SIZE, k1_std=0.0)
    assert off(exactly) < min(0.01, 3 * float(exactly.std))
    assert exactly.std < found.std  # what is given is no doubt
    noisy = focal_from_fundamentals(disturbed(matches[0], 2e-3 * noise), CENTER, SIZE)
    assert off(noisy) < min(0.02, 3 * float(noisy.std))
    assert noisy.success


def test_wrong_pairs_are_no_inliers() -> None:
    F, *_ = pairs(noise=0.3)
    wrong = torch.arange(len(F)) < 6
    shuffled = torch.where(wrong[:, None, None], disturbed(F, 1.0), F)
    found = focal_from_fundamentals(shuffled, CENTER, SIZE)
    assert found.success
    assert off(found) < 0.01
    torch.testing.assert_close(found.inliers, ~wrong)


def test_pairs_of_another_camera_are_no_inliers() -> None:
    F, pixels_1, pixels_2, mask = pairs(noise=0.3)
    other = torch.arange(len(F)) < 6
    zoom = torch.tensor(((1.5, 0.0, -159.75), (0.0, 1.5, -119.75), (0.0, 0.0, 1.0)), dtype=torch.float64)
    back = torch.linalg.inv(zoom)
    pixels_1, pixels_2 = (
        torch.where(other[:, None, None], 1.5 * x - 0.5 * CENTER, x) for x in (pixels_1, pixels_2)
    )
    F = torch.where(other[:, None, None], back.mT @ F @ back, F)
    found = focal_from_pairs(F, pixels_1, pixels_2, mask, CENTER, SIZE)
    assert found.success
    assert off(found) < 0.03
    assert (found.inliers & other).sum() <= 1  # one that tells little
    assert (found.inliers & ~other).sum() >= 12


def test_distortion_is_estimated_too() -> None:
    matches = pairs(noise=0.3, camera=BENT)
    found = focal_from_pairs(*matches, CENTER, SIZE)
    assert off(found) < 0.015
    assert float(found.k1) == pytest.approx(0.04, abs=0.015)
    straight = focal_from_pairs(*matches, CENTER, SIZE, k1_std=0.0)
    assert off(straight) > 2 * off(found)
    assert straight.k1 == 0


MOTIONS = {
    "rotation": (0.1 * normal(20, 3), torch.zeros(20, 3, dtype=torch.float64)),
    "forward": (
        torch.zeros(20, 3, dtype=torch.float64),
        torch.tensor((0.0, 0.0, 0.5), dtype=torch.float64).expand(20, 3),
    ),
    "parallel axes": (0.1 * normal(20, 3) * torch.tensor((0.0, 0.0, 1.0)), 0.3 * normal(20, 3, seed=1)),
}


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize("name", [*MOTIONS, "orbit", "plane"])
def test_what_does_not_determine_it_is_no_success(name: str, noise: float) -> None:
    if name == "plane":
        matches = pairs(noise=noise, plane=True)
    elif name == "orbit":  # around a point that both optical axes meet, five away
        omega = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64) * torch.linspace(0.1, 0.4, 20)[:, None]
        center = torch.tensor((0.0, 0.0, 5.0), dtype=torch.float64)
        matches = moving(omega, center - so3_exp(omega) @ center, noise)
    else:
        matches = moving(*MOTIONS[name], noise)
    F, pixels_1, pixels_2, mask = matches
    found = focal_from_pairs(F, pixels_1.requires_grad_(), pixels_2, mask, CENTER, SIZE)
    assert not found.success
    assert not found.focal.requires_grad
    assert not any(
        getattr(found, field.name).isnan().any() for field in fields(found) if field.name != "errors"
    )
    if name not in ("rotation", "plane"):  # whose matrices are arbitrary: these cannot be told by themselves
        assert not focal_from_fundamentals(F, CENTER, SIZE).success


def test_too_few_pairs_are_no_success() -> None:
    F, pixels_1, pixels_2, mask = pairs(2)
    for M in (0, 1):
        assert not focal_from_fundamentals(F[:M], CENTER, SIZE).success
        assert not focal_from_pairs(F[:M], pixels_1[:M], pixels_2[:M], mask[:M], CENTER, SIZE).success
    nothing = focal_from_pairs(F, pixels_1, pixels_2, torch.zeros_like(mask), CENTER, SIZE)
    assert not nothing.success
    assert nothing.errors.isnan().all()


def test_gradient_to_matrices_and_weights() -> None:
    F = scaled(disturbed(pairs(6)[0], 3e-4)).requires_grad_()
    weights = 0.5 + torch.rand(6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def focal(F: Tensor, weights: Tensor) -> Tensor:
        return focal_from_fundamentals(in_pixels(F), CENTER, SIZE, weights).focal

    assert torch.autograd.gradcheck(focal, (F, weights.requires_grad_()), eps=1e-6, fast_mode=True)


def test_gradient_to_matches() -> None:
    """At exact matches, where the noise level, which is held fixed, does not change."""
    F, pixels_1, pixels_2, mask = pairs(4, noise=0.0, matches=60)

    def focal(pixels_1: Tensor, pixels_2: Tensor) -> Tensor:
        return focal_from_pairs(F, pixels_1, pixels_2, mask, CENTER, SIZE).focal

    inputs = pixels_1.requires_grad_(), pixels_2.requires_grad_()
    gradients = torch.autograd.grad(focal(*inputs), inputs)
    changes = [normal(*x.shape, seed=seed) for seed, x in enumerate(inputs)]
    step = 1e-4
    with torch.no_grad():
        ahead, back = (
            focal(*(x + s * c for x, c in zip(inputs, changes, strict=True))) for s in (step, -step)
        )
    along = sum(float((g * c).sum()) for g, c in zip(gradients, changes, strict=True))
    assert along == pytest.approx(float(ahead - back) / (2 * step), rel=1e-3)


def test_weights_count_pairs() -> None:
    F, pixels_1, pixels_2, mask = pairs(12)
    weights = torch.ones(12, dtype=torch.float64)
    weights[3] = 0.0
    rest = torch.arange(12) != 3
    whole = focal_from_pairs(F, pixels_1, pixels_2, mask, CENTER, SIZE, weights)
    part = focal_from_pairs(F[rest], pixels_1[rest], pixels_2[rest], mask[rest], CENTER, SIZE)
    torch.testing.assert_close(whole.focal, part.focal, rtol=1e-6, atol=0)
    torch.testing.assert_close(whole.std, part.std, rtol=1e-4, atol=0)
    assert whole.errors[3].isnan()
    assert not whole.inliers[3]
    F = disturbed(F, 1e-3)
    twice = focal_from_fundamentals(torch.cat((F, F[:1])), CENTER, SIZE)
    weights = torch.ones(12, dtype=torch.float64)
    weights[0] = 2.0
    found = focal_from_fundamentals(F, CENTER, SIZE, weights)
    torch.testing.assert_close(found.focal, twice.focal, rtol=1e-9, atol=0)


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0])
def test_a_matrix_that_is_none_is_left_out(value: float) -> None:
    F, pixels_1, pixels_2, mask = pairs(8)
    good = focal_from_pairs(F[1:], pixels_1[1:], pixels_2[1:], mask[1:], CENTER, SIZE).focal
    F[0] = value
    found = focal_from_pairs(F, pixels_1, pixels_2, mask, CENTER, SIZE)
    torch.testing.assert_close(found.focal, good, rtol=1e-6, atol=0)
    both = (focal_from_fundamentals(each, CENTER, SIZE).focal for each in (F, F[1:]))
    torch.testing.assert_close(*both, rtol=1e-9, atol=0)


def test_order_scale_and_sign_do_not_matter() -> None:
    F, pixels_1, pixels_2, mask = pairs(12)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    one = focal_from_pairs(F, pixels_1, pixels_2, mask, CENTER, SIZE)
    scaled = 3 * normal(12, 1, 1) * F
    other = focal_from_pairs(*(x[order] for x in (scaled, pixels_1, pixels_2, mask)), CENTER, SIZE)
    torch.testing.assert_close(one.focal, other.focal, rtol=1e-6, atol=0)
    torch.testing.assert_close(one.errors[order], other.errors, rtol=1e-4, atol=1e-6)
    # from the second views to the first
    back = focal_from_pairs(F.mT, pixels_2, pixels_1, mask, CENTER, SIZE)
    torch.testing.assert_close(one.focal, back.focal, rtol=1e-6, atol=0)


def test_single_precision() -> None:
    matches = pairs(10)
    F, pixels_1, pixels_2, mask = (x.float() if x.is_floating_point() else x for x in matches)
    found = focal_from_pairs(F, pixels_1, pixels_2, mask, CENTER.float(), SIZE)
    exactly = focal_from_pairs(*matches, CENTER, SIZE)
    assert found.focal.dtype == found.std.dtype == found.errors.dtype == torch.float32
    torch.testing.assert_close(found.focal.double(), exactly.focal, rtol=1e-3, atol=0)
    with pytest.raises(ValueError, match="principal_point is torch"):
        focal_from_pairs(F, pixels_1, pixels_2, mask, CENTER, SIZE)


@pytest.mark.data
@pytest.mark.parametrize(("name", "frames"), [("fr2_desk_20", range(0, 20, 2)), ("garden", range(20, 60, 4))])
def test_real_pairs_give_the_focal_length(data_dir: Path, name: str, frames: range) -> None:
    sequence = open_sequence(data_dir / name)
    camera = sequence.camera
    sift, keypoints, descriptors = cv2.SIFT_create(1500), [], []
    for index in frames:
        image = (255 * sequence[index].image.squeeze()).byte().numpy()
        found, descriptor = sift.detectAndCompute(image, None)
        pixels = torch.tensor([keypoint.pt for keypoint in found], dtype=torch.float64)
        keypoints.append(camera.focal * camera.normalize(pixels) + CENTER)  # undistorted
        descriptors.append(torch.tensor(descriptor) / torch.tensor(descriptor).norm(dim=-1, keepdim=True))
    matrices, matches = [], []
    for i, j in [(i, i + gap) for gap in (1, 2, 3) for i in range(len(frames) - gap)]:
        similarity = descriptors[i] @ descriptors[j].mT
        (best, second), (index, _) = (x.unbind(-1) for x in similarity.topk(2, dim=-1))
        mutual = similarity.argmax(0)[index] == torch.arange(len(index))
        good = mutual & (2 - 2 * best < 0.8**2 * (2 - 2 * second))
        pixels_1, pixels_2 = keypoints[i][good], keypoints[j][index[good]]
        F, inliers = cv2.findFundamentalMat(
            pixels_1.numpy(), pixels_2.numpy(), cv2.USAC_MAGSAC, 1.0, 0.999, 5000
        )
        matrices.append(torch.tensor(F))
        matches.append(torch.cat((pixels_1, pixels_2), dim=-1)[torch.tensor(inliers.ravel() > 0)])
    padded = torch.nn.utils.rnn.pad_sequence(matches, batch_first=True, padding_value=np.nan)
    found = focal_from_pairs(
        torch.stack(matrices),
        padded[..., :2],
        padded[..., 2:],
        ~padded[..., 0].isnan(),
        CENTER,
        sequence.camera.size,
    )
    assert found.success
    assert float(found.focal) == pytest.approx(float(camera.focal), rel=0.05)
