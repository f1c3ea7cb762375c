import pytest
import torch
from geometry_scenes import CAMERA, FISHEYE, RADIAL
from torch import Tensor
from torch.autograd import gradcheck

from torchslam.geometry import (
    Camera,
    correct_matches,
    se3_exp,
    se3_inverse,
    skew,
    transform,
    triangulate,
    triangulate_many,
    triangulation_covariance,
)


def views(
    camera: Camera = CAMERA, count: int = 30, noise: float = 0.0, extra: int = 0
) -> tuple[Tensor, Tensor, Tensor]:
    """Poses (V, 4, 4), pixels (N, V, 2) and points (N, 3)."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    steps = torch.tensor(((-0.4, 0.02, 0.05, 0.02, -0.03, 0.01),), dtype=torch.float64)
    steps = torch.cat(
        (0.0 * steps, steps, steps * torch.linspace(-1, 2, extra)[:, None] + 0.05 * normal(extra, 6))
    )
    T_cw = se3_exp(steps) @ se3_exp(0.3 * normal(6))
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    points_c = (uniform - 0.5) * torch.tensor((3.0, 2.0, 4.0)) + torch.tensor((0.0, 0.0, 5.0))
    points_w = transform(se3_inverse(T_cw[0]), points_c)
    pixels = camera.project(transform(T_cw, points_w))[0].transpose(0, 1)
    return T_cw, pixels + noise * normal(*pixels.shape), points_w


@pytest.mark.parametrize("camera", [CAMERA, RADIAL, FISHEYE], ids=["pinhole", "radial_tangential", "fisheye"])
def test_exact_matches_recover_the_points(camera: Camera) -> None:
    T_cw, pixels, points_w = views(camera, extra=2)
    two = triangulate(
        pixels[:, 0], pixels[:, 1], T_1w=T_cw[0], T_2w=T_cw[1], camera_1=camera, camera_2=camera
    )
    many = triangulate_many(pixels, T_cw=T_cw, camera=camera)
    centers = se3_inverse(T_cw)[:, :3, 3]
    rays = points_w - centers[0], points_w - centers[1]
    angles = torch.acos(torch.nn.functional.cosine_similarity(*rays, dim=-1))
    for result in (two, many):
        assert result.mask.all()
        torch.testing.assert_close(result.points_w, points_w, atol=1e-9, rtol=0)
    torch.testing.assert_close(two.angles, angles, atol=1e-7, rtol=0)
    assert (many.angles >= two.angles - 1e-9).all()
    assert float(two.errors_1.max()) < 1e-8
    assert float(many.errors.max()) < 1e-8
    torch.testing.assert_close(two.depths_2, transform(T_cw[1], points_w)[:, 2])


def test_two_views_reach_the_least_reprojection_error() -> None:
    T_cw, pixels, _ = views(noise=1.0)
    two = triangulate(
        pixels[:, 0], pixels[:, 1], T_1w=T_cw[0], T_2w=T_cw[1], camera_1=CAMERA, camera_2=CAMERA
    )
    many = triangulate_many(pixels, T_cw=T_cw, camera=CAMERA, iterations=10)
    cost = two.errors_1.square() + two.errors_2.square()
    torch.testing.assert_close(cost, many.errors.square().sum(-1), rtol=1e-6, atol=1e-9)


def test_corrected_matches_satisfy_the_constraint() -> None:
    T_cw, pixels, _ = views(noise=1.0)
    T_21 = T_cw[1] @ se3_inverse(T_cw[0])
    E = skew(T_21[:3, 3]) @ T_21[:3, :3]
    x_1, x_2 = correct_matches(E, CAMERA.normalize(pixels[:, 0]), CAMERA.normalize(pixels[:, 1]))
    h_1, h_2 = (torch.cat((x, torch.ones_like(x[:, :1])), dim=-1) for x in (x_1, x_2))
    assert float((h_2 * (h_1 @ E.mT)).sum(-1).abs().max()) < 1e-12


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("camera", [CAMERA, RADIAL], ids=["pinhole", "radial_tangential"])
def test_gradients(camera: Camera, noise: float) -> None:
    T_cw, pixels, _ = views(camera, count=3, noise=noise)
    inputs = [x.clone().requires_grad_() for x in (T_cw, pixels, camera.params)]

    def two(T_cw: Tensor, pixels: Tensor, params: Tensor) -> tuple[Tensor, ...]:
        one = camera.with_params(params)
        result = triangulate(
            pixels[:, 0], pixels[:, 1], T_1w=T_cw[0], T_2w=T_cw[1], camera_1=one, camera_2=one
        )
        return result.points_w, result.angles, *((result.errors_1,) if noise else ())

    def many(T_cw: Tensor, pixels: Tensor, params: Tensor) -> tuple[Tensor, ...]:
        result = triangulate_many(pixels, T_cw=T_cw, camera=camera.with_params(params))
        return result.points_w, result.angles, *((result.errors,) if noise else ())

    assert gradcheck(two, inputs)
    assert gradcheck(many, inputs)


def test_bad_rows_are_masked_and_finite(dtype: torch.dtype) -> None:
    T_cw, pixels, _ = (x.to(dtype) for x in views(noise=0.1))
    pixels[0], pixels[1, 1] = torch.nan, torch.inf
    behind = 2 * transform(T_cw, views()[2].to(dtype))[:, 2, :2]  # arbitrary, but far from the epipolar line
    pixels[2, 1] = pixels[2, 0] + behind[0]
    pixels[3] = pixels[3, :1]
    given = torch.ones(len(pixels), dtype=torch.bool)
    given[4] = False
    T_cw, pixels = T_cw.requires_grad_(), pixels.requires_grad_()
    camera = CAMERA.to(dtype)
    two = triangulate(
        pixels[:, 0], pixels[:, 1], T_1w=T_cw[0], T_2w=T_cw[1], camera_1=camera, camera_2=camera, mask=given
    )
    many = triangulate_many(pixels, T_cw=T_cw, camera=camera, mask=given[:, None].expand(-1, 2))
    assert not two.mask[[0, 1, 4]].any()
    assert not many.mask[[0, 1, 4]].any()
    assert torch.isinf(two.errors_1[[0, 1, 4]]).all()
    loss = sum(
        x.sum() for x in (two.points_w, two.angles, two.depths_1, two.depths_2, many.points_w, many.angles)
    )
    assert torch.isfinite(loss)
    loss.backward()
    assert torch.isfinite(T_cw.grad).all()
    assert torch.isfinite(pixels.grad).all()


def test_zero_baseline_or_parallel_rays_give_no_point() -> None:
    T_cw, pixels, _ = views()
    same = triangulate(
        pixels[:, 0], pixels[:, 0], T_1w=T_cw[0], T_2w=T_cw[0], camera_1=CAMERA, camera_2=CAMERA
    )
    assert not same.mask.any()
    assert torch.isfinite(same.points_w).all()
    one_view = triangulate_many(
        pixels, T_cw=T_cw, camera=CAMERA, mask=torch.tensor((True, False)).expand(len(pixels), 2)
    )
    assert not one_view.mask.any()


def test_covariance_is_that_of_noisy_triangulations() -> None:
    T_cw, pixels, points_w = views(RADIAL)
    sigmas = torch.full_like(points_w[:, 0], 0.3)
    covariances = triangulation_covariance(T_cw[0], T_cw[1], points_w, sigmas, sigmas, RADIAL, RADIAL)
    generator = torch.Generator().manual_seed(1)
    noise = 0.3 * torch.randn(200, *pixels.shape, generator=generator, dtype=torch.float64)
    errors = triangulate_many(pixels + noise, T_cw=T_cw, camera=RADIAL).points_w - points_w
    squared = (errors * torch.linalg.solve(covariances, errors[..., None]).squeeze(-1)).sum(-1)
    assert 0.9 < float(squared.mean()) / 3 < 1.1
    half = triangulation_covariance(T_cw[0], T_cw[1], points_w, sigmas / 2, sigmas / 2, RADIAL, RADIAL)
    torch.testing.assert_close(half, covariances / 4)


def test_covariance_is_zero_where_the_views_do_not_determine_a_point(device: torch.device) -> None:
    T_cw, _, points_w = (x.to(device) for x in views())
    camera, sigmas = CAMERA.to(device), torch.ones_like(points_w[:, 0])
    no_parallax = triangulation_covariance(T_cw[0], T_cw[0], points_w, sigmas, sigmas, camera, camera)
    behind = triangulation_covariance(T_cw[0], T_cw[1], -points_w, sigmas, sigmas, camera, camera)
    assert (no_parallax == 0).all()
    assert (behind == 0).flatten(1).all(-1).any()
    assert torch.isfinite(behind).all()


def test_undistorted_coordinates_give_the_same_points() -> None:
    T_cw, pixels, _ = views(RADIAL, noise=1.0)
    seen = pixels[:, 0], pixels[:, 1]
    known = RADIAL.normalize(seen[0]), RADIAL.normalize(seen[1])
    one, two = (
        triangulate(*seen, T_1w=T_cw[0], T_2w=T_cw[1], camera_1=RADIAL, camera_2=RADIAL, normalized=x)
        for x in (None, known)
    )
    assert all(torch.equal(part, vars(two)[name]) for name, part in vars(one).items())


@pytest.mark.parametrize("camera", [CAMERA, RADIAL], ids=["pinhole", "radial_tangential"])
@pytest.mark.parametrize("many", [False, True])
def test_a_pixel_that_is_not_finite_leaves_the_gradient_of_the_others(camera: Camera, many: bool) -> None:
    """Also where the mask excludes it."""
    T_cw, pixels, _ = views(camera, noise=0.5)
    mask = torch.arange(len(pixels)) != 3

    def gradient(pixels: Tensor) -> Tensor:
        params = camera.params.clone().requires_grad_()
        own = camera.with_params(params)
        if many:
            found = triangulate_many(pixels, T_cw=T_cw, camera=own, mask=mask[:, None].expand(-1, 2))
            errors = found.errors.sum(-1)
        else:
            found = triangulate(
                *pixels.unbind(1), T_1w=T_cw[0], T_2w=T_cw[1], camera_1=own, camera_2=own, mask=mask
            )
            errors = found.errors_1 + found.errors_2
        (of_params,) = torch.autograd.grad(
            torch.where(found.mask[..., None], found.points_w, 0.0).sum()
            + torch.where(found.mask, errors, 0.0).sum(),
            params,
        )
        return of_params

    bad = pixels.clone()
    bad[3, 1] = torch.nan
    expected = gradient(pixels)
    assert expected.abs().max() > 0
    torch.testing.assert_close(gradient(bad), expected)


@pytest.mark.parametrize("many", [False, True], ids=["triangulate", "triangulate_many"])
def test_the_hessian_through_a_distortion_agrees_with_differences_of_the_gradient(many: bool) -> None:
    camera = Camera.radial_tangential(458.0, 457.0, 367.0, 248.0, -0.28, 0.07, 2e-4, 2e-5, size=(752, 480))
    T_cw = se3_exp(torch.tensor([[0.0] * 6, [-0.5, 0.1, 0.0, 0.02, 0.1, 0.03]], dtype=torch.float64))
    points_w = torch.tensor([[0.3, -0.2, 4.0], [-1.0, 0.5, 3.0]], dtype=torch.float64)
    pixels = camera.project(transform(T_cw, points_w))[0]

    def loss(pixels: Tensor) -> Tensor:
        if many:
            points = triangulate_many(pixels.transpose(0, 1), T_cw=T_cw, camera=camera).points_w
        else:
            points = triangulate(
                *pixels, T_1w=T_cw[0], T_2w=T_cw[1], camera_1=camera, camera_2=camera
            ).points_w
        return (points**3).sum()

    hessian = torch.func.hessian(loss)(pixels)
    gradient = torch.func.grad(loss)
    step = 1e-3 * torch.randn(pixels.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    difference = (gradient(pixels + step) - gradient(pixels - step)) / 2
    found = torch.tensordot(hessian, step, dims=3)
    torch.testing.assert_close(found, difference, rtol=1e-5, atol=1e-9)
