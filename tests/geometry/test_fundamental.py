"""Fundamental matrices refined on matches: the minimum, its uncertainty, its gradient, and planes."""

from __future__ import annotations

import pytest
import torch
from geometry_scenes import CAMERA, many_views
from torch import Tensor

from torchslam.geometry import essential_from_pose, sampson_errors, so3_exp
from torchslam.geometry.fundamental import RefinedFundamental, homography_share, refine_fundamental

SCALE = 640.0
CENTER = CAMERA.params[2:]
PIXEL = 1 / SCALE


def matrix_of(T_21: Tensor, focal: float = 525.0) -> Tensor:
    """F of norm one, for pixels from the principal point in widths."""
    inverse = torch.diag(torch.tensor((1.0, 1.0, focal / SCALE), dtype=torch.float64))
    F = inverse @ essential_from_pose(T_21[:, :3, :3], T_21[:, :3, 3]) @ inverse
    return F / F.flatten(1).norm(dim=1)[:, None, None]


def matches(noise: float, seeds: range, **options: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x_1, x_2, the mask of right matches and the true F of a pair per seed."""
    scene = many_views(seeds, noise=noise, **{"outliers": 0.0, **options})
    x_1, x_2 = ((pixels - CENTER) / SCALE for pixels in (scene.pixels_1, scene.pixels_2))
    return x_1, x_2, scene.mask, matrix_of(scene.T_21)


def moved(F: Tensor, size: float, seed: int = 0) -> Tensor:
    return F + size * torch.randn(F.shape, generator=torch.Generator().manual_seed(seed), dtype=F.dtype)


def signed(found: Tensor, true: Tensor) -> Tensor:
    return found * torch.sign((found * true).sum((1, 2)))[:, None, None]


def test_exact_matches_give_the_matrix() -> None:
    x_1, x_2, mask, true = matches(0.0, range(5))
    found = refine_fundamental(-7 * moved(true, 0.003), x_1, x_2, mask, PIXEL).F_21
    assert ((found * true).sum((1, 2)) < 0).all()  # the sign is that of the given ones
    torch.testing.assert_close(signed(found, true), true, rtol=0, atol=1e-9)
    assert torch.linalg.det(found).abs().max() < 1e-12


def test_equal_singular_values_are_no_special_case() -> None:
    """They are, with the focal length as the unit, those of every pair."""
    x_1, x_2, mask, _ = matches(0.5, range(3))
    factor = SCALE / 525.0
    true = matrix_of(many_views(range(3)).T_21, SCALE)
    found = refine_fundamental(true, factor * x_1, factor * x_2, mask, factor * PIXEL)
    _, values, _ = torch.linalg.svd(found.covariance)
    assert (values[:, 6] > 1e-9).all()  # seven directions are uncertain
    assert (values[:, 7] < 1e-12).all()
    assert (signed(found.F_21, true) - true).abs().max() < 0.05


def test_a_few_wrong_matches_do_not_matter() -> None:
    x_1, x_2, _, true = matches(0.3, range(4), outliers=0.1)
    found = refine_fundamental(true, x_1, x_2, torch.ones_like(x_1[..., 0], dtype=torch.bool), PIXEL)
    right = matches(0.3, range(4), outliers=0.1)[2]
    distances = sampson_errors(found.F_21, x_1, x_2).abs() * SCALE
    assert (distances.masked_fill(~right, torch.nan).nanmedian(-1).values < 0.4).all()
    torch.testing.assert_close(found.noise * SCALE, torch.full_like(found.noise, 0.3), rtol=0.25, atol=0)


def test_the_covariance_is_that_of_the_noise() -> None:
    """Of 150 noisy copies of one pair, the squared errors are on average the number of parameters."""
    x_1, x_2, mask, true = matches(0.0, range(1))
    generator = torch.Generator().manual_seed(1)
    noisy = [
        x.expand(150, -1, -1)
        + 0.5 * PIXEL * torch.randn(150, *x.shape[1:], generator=generator, dtype=x.dtype)
        for x in (x_1, x_2)
    ]
    found = refine_fundamental(true.expand(150, 3, 3), *noisy, mask.expand(150, -1), PIXEL)
    error = (found.F_21 - true).flatten(1)
    squared = (error[:, None] @ torch.linalg.pinv(found.covariance, rtol=1e-9) @ error[:, :, None]).flatten()
    assert 0.85 * 7 < float(squared.mean()) < 1.25 * 7


def test_bend_is_the_derivative() -> None:
    x_1, x_2, mask, true = matches(0.0, range(4))
    found = refine_fundamental(true, x_1, x_2, mask, PIXEL)
    step = 1e-5

    def at(k: float) -> Tensor:
        bent = (x * (1 + k * x.square().sum(-1, keepdim=True)) for x in (x_1, x_2))
        return refine_fundamental(true, *bent, mask, PIXEL).F_21.flatten(1)

    torch.testing.assert_close(found.bend, (at(step) - at(-step)) / (2 * step), rtol=1e-3, atol=1e-4)


def test_gradient() -> None:
    x_1, x_2, mask, true = matches(0.5, range(2), count=30)

    def refined(x_1: Tensor, x_2: Tensor) -> Tensor:
        return refine_fundamental(true, x_1, x_2, mask, PIXEL).F_21

    x_1, x_2 = x_1.requires_grad_(), x_2.requires_grad_()
    assert torch.autograd.gradcheck(refined, (x_1, x_2), eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)


def test_covariance_has_no_gradient() -> None:
    x_1, x_2, mask, true = matches(0.5, range(1))
    found: RefinedFundamental = refine_fundamental(true, x_1.requires_grad_(), x_2, mask, PIXEL)
    assert not found.covariance.requires_grad
    assert not found.bend.requires_grad


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_planes_and_rotating_cameras_are_told_from_scenes(noise: float) -> None:
    def share(x_1: Tensor, x_2: Tensor, mask: Tensor) -> Tensor:
        return homography_share(x_1, x_2, mask, torch.full((len(x_1),), noise * PIXEL, dtype=x_1.dtype))

    assert (share(*matches(noise, range(5))[:3]) < 0.5).all()
    assert (share(*matches(noise, range(5), plane=True)[:3]) > 0.9).all()
    assert (share(*matches(noise, range(5), outliers=0.3, plane=True)[:2], mask_of(5)) > 0.6).all()
    x_1, _, mask, _ = matches(noise, range(1))
    K = torch.diag(torch.tensor((525 / SCALE, 525 / SCALE, 1.0), dtype=torch.float64))
    h = torch.nn.functional.pad(x_1, (0, 1), value=1.0)
    turned = h @ (K @ so3_exp(torch.tensor((0.05, 0.1, 0.1), dtype=torch.float64)) @ K.inverse()).mT
    turned = turned[..., :2] / turned[..., 2:]
    turned = turned + noise * PIXEL * torch.randn(
        turned.shape, generator=torch.Generator().manual_seed(0), dtype=turned.dtype
    )
    assert (share(x_1, turned, mask) > 0.9).all()


def mask_of(pairs: int) -> Tensor:
    return torch.ones(pairs, 200, dtype=torch.bool)
