"""Geometry compiles to one graph, solvers to several: the same values and gradients as without `torch.compile`."""

from __future__ import annotations

import subprocess
import sys

import pytest

SCRIPT = """
import torch
from torchslam.geometry import Camera, se3_exp, transform
from torchslam.optim import solve_pose

camera = Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480))
tangent = torch.tensor([[0.1, -0.2, 0.05, 0.02, 0.1, -0.03]], dtype=torch.float64)
points_w = torch.rand(1, 20, 3, dtype=torch.float64) + torch.tensor([-0.5, -0.5, 3])
inputs = tuple(each.requires_grad_() for each in (points_w, camera.params.clone()))
noise = torch.sin(torch.arange(40.0)).reshape(1, 20, 2)

def reprojected(points_w, params):
    return camera.with_params(params).project(transform(se3_exp(tangent), points_w))[0]

pixels = reprojected(*inputs).detach() + noise

def posed(points_w, params):
    start = torch.eye(4, dtype=torch.float64)[None]
    return solve_pose(points_w, pixels, T_cw=start, camera=camera.with_params(params)).T_cw

for function, fullgraph in ((reprojected, True), (posed, False)):
    compiled = torch.compile(function, fullgraph=fullgraph, backend="aot_eager")  # needs no compiler of C++
    found, expected = compiled(*inputs), function(*inputs)
    torch.testing.assert_close(found, expected)
    gradients = [torch.autograd.grad(each.sum(), inputs) for each in (found, expected)]
    torch.testing.assert_close(*gradients)
"""


@pytest.mark.slow
def test_compiled_functions_have_the_same_values_and_gradients() -> None:
    """In a process of its own: the checks of shapes in the tests cannot be compiled."""
    subprocess.run([sys.executable, "-c", SCRIPT], check=True)
