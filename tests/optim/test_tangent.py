import torch

from torchslam.geometry import se3_exp, transform
from torchslam.optim import PosePrior
from torchslam.optim._core.tangent import (
    move,
    point_jacobian,
    prior_error,
    prior_expansion,
    prior_hessian,
    pull_back,
    retract,
)


def test_retraction_agrees_with_the_exponential_and_stays_rigid(generator):
    T = se3_exp(torch.randn(7, 6, generator=generator, dtype=torch.float64))
    xi = torch.randn(7, 6, generator=generator, dtype=torch.float64)
    R = retract(T, xi)[:, :3, :3]
    eye = torch.eye(3, dtype=torch.float64).expand(7, 3, 3)
    torch.testing.assert_close(R @ R.mT, eye, atol=1e-14, rtol=0)
    torch.testing.assert_close(retract(T, 1e-6 * xi), se3_exp(1e-6 * xi) @ T, atol=1e-11, rtol=0)
    assert torch.equal(retract(T, 0 * xi), T)


def test_pull_back_is_the_gradient_in_the_tangent(generator):
    T = se3_exp(torch.randn(3, 6, generator=generator, dtype=torch.float64))
    G = torch.randn(3, 4, 4, generator=generator, dtype=torch.float64)
    xi = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad((retract(T, xi) * G).sum(), xi)
    torch.testing.assert_close(pull_back(T, G), expected)


def test_points_move_by_the_tangent(generator):
    points = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    direction = torch.randn(6, generator=generator, dtype=torch.float64)
    eye = torch.eye(4, dtype=torch.float64)
    step = torch.zeros((), dtype=torch.float64)
    moved = torch.autograd.functional.jacobian(lambda h: transform(retract(eye, h * direction), points), step)
    torch.testing.assert_close(move(points, direction.expand(5, 6)), moved)
    torch.testing.assert_close((point_jacobian(points) @ direction), moved)


def make_prior(generator):
    A = torch.randn(3, 6, 6, generator=generator, dtype=torch.float64)
    T_cw = se3_exp(torch.randn(3, 6, generator=generator, dtype=torch.float64))
    offset = se3_exp(0.3 * torch.randn(3, 6, generator=generator, dtype=torch.float64))
    return PosePrior(T_cw, A @ A.mT), offset @ T_cw


def test_the_prior_error_vanishes_at_the_prior_and_has_the_right_jacobian(generator):
    prior, T_cw = make_prior(generator)
    error, _ = prior_error(prior, prior.T_cw)
    torch.testing.assert_close(error, torch.zeros_like(error), atol=1e-12, rtol=0)
    _, J = prior_error(prior, T_cw)
    zero = torch.zeros(3, 6, dtype=torch.float64)
    expected = torch.autograd.functional.jacobian(lambda xi: prior_error(prior, retract(T_cw, xi))[0], zero)
    rows = torch.arange(3)
    torch.testing.assert_close(J, expected[rows, :, rows])


def test_expansion_and_exact_hessian_agree_with_autograd(generator):
    prior, T_cw = make_prior(generator)
    zero = torch.zeros(3, 6, dtype=torch.float64)

    def cost(xi):
        return prior_expansion(prior, retract(T_cw, xi))[0].sum()

    torch.testing.assert_close(
        prior_expansion(prior, T_cw)[1], torch.autograd.functional.jacobian(cost, zero)
    )
    hessian = torch.autograd.functional.hessian(cost, zero)
    rows = torch.arange(3)
    torch.testing.assert_close(prior_hessian(prior, T_cw), hessian[rows, :, rows])
