from dataclasses import replace

import pytest
import torch

from torchslam.optim._core.residuals import (
    ReprojectionData,
    exact_expansion,
    gauss_newton_expansion,
    linearize,
    usable,
    variance_factor,
)


@pytest.fixture
def make_observations(make_camera, generator):
    def make(model="pinhole", kernel="cauchy", count=6, noise=1.0):
        points_c = torch.randn(count, 3, generator=generator, dtype=torch.float64)
        points_c[:, 2] = 3 + points_c[:, 2].abs()
        camera = make_camera(model)
        error = noise * torch.randn(count, 2, generator=generator, dtype=torch.float64)
        weights = torch.rand(count, generator=generator, dtype=torch.float64) + 0.5
        scale = torch.tensor(1.5, dtype=torch.float64)
        return ReprojectionData(camera.project(points_c)[0] + error, weights, camera, kernel, scale), points_c

    return make


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy", "geman_mcclure"])
@pytest.mark.parametrize("free_camera", [False, True])
def test_the_exact_expansion_agrees_with_autograd(make_observations, model, kernel, free_camera):
    observations, points_c = make_observations(model, kernel)
    expansion = exact_expansion(observations, points_c, free_camera)
    for row in range(len(points_c)):
        one = replace(
            observations,
            pixels=observations.pixels[row : row + 1],
            weights=observations.weights[row : row + 1],
        )

        def cost(variables, one=one):
            params = variables[3:] if free_camera else one.camera.params
            camera = one.camera.with_params(params)
            return linearize(replace(one, camera=camera), variables[None, :3]).cost.sum()

        variables = torch.cat((points_c[row], observations.camera.params)) if free_camera else points_c[row]
        gradient = torch.autograd.functional.jacobian(cost, variables)
        hessian = torch.autograd.functional.hessian(cost, variables)
        torch.testing.assert_close(expansion.gradient[row], gradient)
        torch.testing.assert_close(expansion.hessian[row], hessian, atol=1e-7, rtol=1e-7)


def test_gauss_newton_expansion_is_semi_definite_and_exact_for_small_residuals(make_observations):
    for use_curvature in (False, True):
        observations, points_c = make_observations(noise=20.0)
        lin = linearize(observations, points_c)
        expansion = gauss_newton_expansion(lin, lin.J.movedim(0, -1), torch.tensor(use_curvature))
        assert torch.linalg.eigvalsh(expansion.hessian.movedim(-1, 0)).min() > -1e-9
    observations, points_c = make_observations(noise=1e-7)
    lin = linearize(observations, points_c)
    exact = exact_expansion(observations, points_c)
    expansion = gauss_newton_expansion(lin, lin.J.movedim(0, -1), torch.tensor(True))
    torch.testing.assert_close(expansion.gradient.mT, exact.gradient)
    torch.testing.assert_close(expansion.hessian.movedim(-1, 0), exact.hessian, atol=1e-4, rtol=1e-6)


def test_a_point_behind_the_camera_has_a_high_cost_without_gradient(make_observations, model, dtype, device):
    observations, points_c = make_observations(model, "none")
    camera = observations.camera.to(device).to(dtype)
    pixels, weights = observations.pixels.to(device, dtype), torch.ones(6, dtype=dtype, device=device)
    behind = points_c.to(device, dtype) * torch.tensor([1.0, 1.0, -1.0], dtype=dtype, device=device)
    observations = ReprojectionData(
        pixels, weights, camera, "none", torch.ones((), dtype=dtype, device=device)
    )
    lin = linearize(observations, behind)
    torch.testing.assert_close(lin.cost, torch.full_like(lin.cost, 0.5 * (640**2 + 480**2)))
    assert (lin.gradient_wrt_residual == 0).all()
    expansion = exact_expansion(observations, behind)
    assert (expansion.gradient == 0).all()
    assert (expansion.hessian == 0).all()
    assert expansion.hessian.dtype == dtype


def test_usable_excludes_non_finite_and_negative_rows():
    pixels, points, weights = torch.zeros(5, 2), torch.zeros(5, 3), torch.ones(5)
    pixels[0, 1], points[1, 2], weights[2], weights[3] = torch.nan, torch.inf, torch.nan, -1
    assert usable(pixels, points, weights).tolist() == [False, False, False, False, True]


def test_variance_factor_is_the_variance_of_unit_weight_for_least_squares(make_observations):
    observations, points_c = make_observations(kernel="none", count=20_000, noise=3.0)
    observations = replace(observations, weights=torch.ones_like(observations.weights))
    factor = variance_factor(observations, linearize(observations, points_c), num_parameters=6)
    assert factor.item() == pytest.approx(9.0, rel=0.05)


def test_variance_factor_without_redundancy_is_one(make_observations):
    observations, points_c = make_observations(count=3)
    assert variance_factor(observations, linearize(observations, points_c), num_parameters=6) == 1
