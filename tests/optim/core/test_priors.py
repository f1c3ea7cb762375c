import torch

from torchslam.geometry import se3_exp
from torchslam.optim import PosePrior
from torchslam.optim._core.priors import prior_error, prior_expansion, prior_hessian
from torchslam.optim._core.tangent import retract


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
