from typing import get_args

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchslam.geometry.robust import Kernel, robustify

KERNELS = get_args(Kernel)


@pytest.fixture(params=KERNELS)
def kernel(request):
    return request.param


def test_agrees_with_least_squares_near_zero(kernel, dtype, device):
    s = torch.tensor([0.0, 1e-9], dtype=dtype, device=device)
    rho, weight, _ = robustify(s, kernel, torch.tensor(2.0, dtype=dtype, device=device))
    torch.testing.assert_close(rho, s)
    torch.testing.assert_close(weight, torch.ones_like(s))
    assert rho.dtype == dtype
    assert rho.device.type == device.type


def test_known_values():
    s, c = torch.tensor([9.0], dtype=torch.float64), torch.tensor(1.5, dtype=torch.float64)
    expected = {
        "none": 9.0,
        "huber": 2 * 1.5 * 3 - 1.5**2,
        "cauchy": 1.5**2 * torch.log1p(s / 1.5**2).item(),
        "geman_mcclure": 9 * 2.25 / 11.25,
        "truncated": 2.25,
    }
    for kernel, value in expected.items():
        assert robustify(s, kernel, c).rho.item() == pytest.approx(value)


@given(st.sampled_from(KERNELS), st.floats(1e-3, 1e3).filter(lambda s: abs(s - 4.0) > 1e-3))
def test_derivatives_are_those_of_rho(kernel, value):
    s = torch.tensor(value, dtype=torch.float64, requires_grad=True)
    rho, weight, curvature = robustify(s, kernel, torch.tensor(2.0, dtype=torch.float64))
    (slope,) = torch.autograd.grad(rho, s, create_graph=True)
    torch.testing.assert_close(weight, slope)
    assert 0 <= weight.item() <= 1
    assert curvature.item() <= 0
    bend = torch.autograd.grad(slope, s)[0] if slope.requires_grad else torch.zeros_like(s)
    torch.testing.assert_close(curvature, bend.expand_as(curvature))


def test_gradient_to_residual_and_scale(kernel):
    s = torch.tensor([0.3, 2.0, 9.0], dtype=torch.float64, requires_grad=True)
    c = torch.tensor(1.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s, c: robustify(s, kernel, c).rho, (s, c))


def test_unknown_kernel_is_named():
    with pytest.raises(ValueError, match=r"'tukey'.*cauchy"):
        robustify(torch.ones(1), "tukey", torch.ones(()))
