"""The oldest frames of a window as a prior."""

from dataclasses import replace

import pytest
import torch

from tests.optim.conftest import adjusted
from torchslam.geometry import se3_exp
from torchslam.optim import BUNDLE_OPTIONS, DepthPrior, Factors, marginalize

CONVERGED = {"kernel": "none", "iterations": 100, "tolerance": 1e-18, "strict": True}
SQUARES = BUNDLE_OPTIONS.replace(kernel="none")


def window(bundle_scene):
    """Six frames of which the last does not see what the first two see, with a distance."""
    scene = bundle_scene(noise=1.0, frames=6, points=40, visible=1.0)
    problem = scene.problem
    early = problem.point_index < 15  # seen by the first four
    seen = torch.where(early, problem.frame_index < 4, problem.frame_index >= 2)
    distance = Factors.distances(
        torch.tensor([(1, 3)]), torch.tensor([0.8]).double(), torch.tensor([1e3]).double()
    )
    return replace(problem, mask=seen, factors=(distance,))


def test_the_minimum_and_its_gradient_stay(bundle_scene):
    """Also of a second step, in which the prior itself is marginalized, from poses that have moved."""
    problem = window(bundle_scene)
    weights = torch.ones(len(problem.pixels), dtype=torch.float64, requires_grad=True)
    problem = replace(problem, weights=weights)
    full = adjusted(problem, **CONVERGED)
    at = replace(problem, T_cw=full.T_cw, points_w=full.points_w)
    noise = se3_exp(0.005 * torch.randn(6, 6, generator=torch.Generator().manual_seed(1)).double())
    pulls = torch.randn(3, 4, 4, generator=torch.Generator().manual_seed(2)).double()
    (expected,) = torch.autograd.grad((pulls * full.T_cw[3:]).sum(), weights, retain_graph=True)
    rest = marginalize(at, [0, 1], options=SQUARES)
    assert len(rest.points_w) == 25
    solution = adjusted(replace(rest, T_cw=noise[2:] @ rest.T_cw.detach()), **CONVERGED)
    torch.testing.assert_close(solution.T_cw, full.T_cw[2:], rtol=0, atol=1e-8)
    second = marginalize(replace(rest, T_cw=solution.T_cw, points_w=solution.points_w), [0], options=SQUARES)
    assert len(second.points_w) == 0
    again = adjusted(replace(second, T_cw=noise[3:] @ second.T_cw.detach()), **CONVERGED)
    torch.testing.assert_close(again.T_cw, full.T_cw[3:], rtol=0, atol=1e-8)
    (gradient,) = torch.autograd.grad((pulls * solution.T_cw[1:]).sum(), weights)
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=1e-9 * float(expected.abs().max()))


def test_what_cannot_be_marginalized_is_refused(bundle_scene):
    problem = window(bundle_scene)
    ones = torch.ones(len(problem.pixels)).double()
    with pytest.raises(ValueError, match="without depths"):
        marginalize(replace(problem, depth_prior=DepthPrior(ones, ones)), [0])
    plane = Factors.planes(torch.tensor([0]), torch.eye(4).double()[:1], ones[:1])
    with pytest.raises(ValueError, match="points that are removed"):
        marginalize(replace(problem, factors=(plane,)), [0])
