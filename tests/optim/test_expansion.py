from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, transform
from torchslam.optim._core.residuals import ReprojectionData
from torchslam.optim._core.tangent import retract
from torchslam.optim.pose import PoseInputs, PoseProblem

PINHOLE = Camera.pinhole(500.0, 480.0, 320.0, 240.0, size=(640, 480))
BENT = Camera.radial_tangential(500.0, 480.0, 320.0, 240.0, -0.2, 0.05, 1e-3, -5e-4, size=(640, 480))
STRAIGHT = Camera.radial_tangential(500.0, 480.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, size=(640, 480))
ALL, NONE = torch.ones(2, dtype=torch.bool), torch.zeros(2, dtype=torch.bool)


def scene(camera: Camera, generator: torch.Generator) -> tuple[Tensor, PoseProblem]:
    """Two poses of 30 points, the first ones far off their pixels and the last one behind the camera."""
    points_w = torch.rand(2, 30, 3, generator=generator, dtype=torch.float64) * 4 - 2
    points_w[..., 2] += 6
    points_w[:, -1, 2] = -5
    T_cw = se3_exp(0.1 * torch.randn(2, 6, generator=generator, dtype=torch.float64))
    pixels, _ = camera.project(transform(T_cw, points_w))
    pixels = pixels + torch.randn(2, 30, 2, generator=generator, dtype=torch.float64)
    pixels[:, :6] += 20
    weights = 0.5 + torch.rand(2, 30, generator=generator, dtype=torch.float64)
    scale = torch.tensor([2.0], dtype=torch.float64)
    observations = ReprojectionData(pixels, weights, camera, "cauchy", scale)
    return T_cw, PoseProblem(PoseInputs(points_w, observations, None))


@pytest.mark.parametrize("camera", [PINHOLE, BENT], ids=["pinhole", "bent"])
def test_the_gradient_agrees_with_autograd(camera: Camera, generator: torch.Generator) -> None:
    T_cw, observations = scene(camera, generator)
    xi = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad(observations.expand(retract(T_cw, xi), NONE).cost.sum(), xi)
    torch.testing.assert_close(observations.expand(T_cw, ALL).gradient, expected)


@pytest.mark.parametrize("camera", [PINHOLE, BENT], ids=["pinhole", "bent"])
def test_the_curvature_is_exact_for_linear_residuals(camera: Camera, generator: torch.Generator) -> None:
    """Hessian and curvature term make the Hessian of the cost, with the residual in its place linear in xi."""
    T_cw, observations = scene(camera, generator)
    inputs = observations.observations
    points_w = observations.points_w

    def residuals(xi: Tensor) -> Tensor:
        return inputs.camera.project(transform(retract(T_cw, xi), points_w))[0] - inputs.pixels

    zero = torch.zeros(2, 6, dtype=torch.float64)
    r = residuals(zero)[:, :-1]
    J = torch.autograd.functional.jacobian(lambda xi: residuals(xi)[:, :-1].sum(0), zero).movedim(2, 0)

    def cost(xi: Tensor) -> Tensor:
        s = inputs.weights[:, :-1] * (r + (J @ xi[:, None, :, None])[..., 0]).square().sum(-1)
        return 0.5 * (4 * torch.log1p(s / 4)).sum()

    exact = torch.autograd.functional.hessian(cost, zero)
    found = observations.expand(T_cw, ALL)
    for row in range(2):
        torch.testing.assert_close((found.hessian + found.curvature_term)[row], exact[row, :, row])
    assert (torch.linalg.eigvalsh(found.hessian) > 0).all()
    assert (torch.linalg.eigvalsh(found.curvature_term) < 1e-6).all()


def test_second_order_curvature_is_added_on_request(generator: torch.Generator) -> None:
    T_cw, observations = scene(PINHOLE, generator)
    everywhere = observations.expand(T_cw, ALL)
    somewhere = observations.expand(T_cw, torch.tensor([True, False]))
    assert torch.equal(somewhere.curvature_term[0], everywhere.curvature_term[0])
    assert (somewhere.curvature_term[1] == 0).all()
    assert (observations.expand(T_cw, NONE).curvature_term == 0).all()


def test_the_pinhole_shortcut_equals_the_general_expansion(generator: torch.Generator) -> None:
    T_cw, short = scene(PINHOLE, generator)
    inputs = short.observations
    straight = ReprojectionData(inputs.pixels, inputs.weights, STRAIGHT, inputs.kernel, inputs.scale)
    general = PoseProblem(PoseInputs(short.points_w, straight, None))
    moved = se3_exp(torch.tensor([0.05, 0, -0.1, 0.01, 0.02, 0.0], dtype=torch.float64)) @ T_cw
    for T in (T_cw, moved):
        torch.testing.assert_close(short.expand(T, ALL), general.expand(T, ALL))
    batch = Camera("pinhole", PINHOLE.params * torch.tensor([[1.0], [1.1]], dtype=torch.float64), (640, 480))
    two = ReprojectionData(inputs.pixels, inputs.weights, batch, inputs.kernel, inputs.scale)
    pair = PoseProblem(PoseInputs(short.points_w, two, None))
    torch.testing.assert_close(pair.expand(T_cw, ALL).hessian[0], short.expand(T_cw, ALL).hessian[0])
    assert not torch.allclose(pair.expand(T_cw, ALL).hessian[1], short.expand(T_cw, ALL).hessian[1])
