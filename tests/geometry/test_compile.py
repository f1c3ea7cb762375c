"""`torch.compile(fullgraph=True)` takes the estimators, with the bits of the eager program, and their gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.geometry.geometry_scenes import points_and_pixels, two_views
from tests.optim.conftest import camera_of
from torchslam.geometry import Camera, RelativePose, estimate_absolute_pose, estimate_relative_pose, se3_exp
from torchslam.geometry.essential import five_point
from torchslam.geometry.p3p import p3p
from torchslam.optim import PosePrior, refine_pose
from torchslam.optim.core.levenberg_marquardt import Convergence

Case = tuple[Callable[..., tuple[Tensor, ...]], list[Tensor]]


# Looked up here: a graph of the oldest torch cannot.
CONVERGENCE, RELATIVE = ([each.name for each in fields(kind)] for kind in (Convergence, RelativePose))


def columns(found: object, names: list[str]) -> tuple[Tensor, ...]:
    return tuple([getattr(found, name) for name in names])


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def compiled(function: Callable[..., Any], backend: str = "aot_eager") -> Callable[..., Any]:
    torch._dynamo.reset()
    return torch.compile(function, fullgraph=True, backend=backend)


def refinement(camera_model: str = "pinhole", **options: Any) -> Case:
    points_w, pixels, T_cw = points_and_pixels(0, count=40, outliers=0.1)
    start, camera = se3_exp(0.01 * normal(1, 6)) @ T_cw, camera_of(camera_model)
    mask = torch.arange(40)[None] % 7 != 0

    def refine(points: Tensor, pixels: Tensor, params: Tensor, weights: Tensor, information: Tensor) -> Any:
        prior = PosePrior(start.to(points), (information[:, :, None] * information[:, None]).sum(-1))
        given = start.to(points), points, pixels, camera.with_params(params), weights, mask
        refined = refine_pose(*given, scale=2.0, prior=prior, **options)
        return refined.T_cw, refined.success, refined.cost, *columns(refined.convergence, CONVERGENCE)

    return refine, [points_w, pixels, camera.params, 0.5 + normal(1, 40).square(), normal(1, 6, 6)]


def absolute() -> Case:
    points_w, pixels, _ = points_and_pixels(0, count=60, outliers=0.3)
    camera = camera_of("radial_tangential")

    def estimate(points: Tensor, pixels: Tensor, params: Tensor) -> Any:
        found = estimate_absolute_pose(points, pixels, camera.with_params(params), 4.0)
        return found.T_cw, found.inliers, found.success, found.score

    return estimate, [points_w, pixels, camera.params]


def relative(weighted: bool, **options: Any) -> Case:
    views = two_views(0, count=80, noise=0.5)
    camera = Camera.pinhole(525.0, 525.0, 319.5, 239.5, (640, 480))

    def estimate(pixels_1: Tensor, pixels_2: Tensor, params: Tensor, *weights: Tensor) -> Any:
        cameras = camera.with_params(params), camera.with_params(1.0 * params)
        given = {"weights": weights[0]} if weights else {}
        found = estimate_relative_pose(pixels_1, pixels_2, *cameras, **given, **options)
        return columns(found, RELATIVE)

    weights = [0.5 + normal(*views.pixels_1.shape[:2]).square()] if weighted else []
    return estimate, [views.pixels_1, views.pixels_2, camera.params.to(views.pixels_1), *weights]


CASES: dict[str, Callable[[], Case]] = {
    "refine_pose": refinement,
    "refine_pose, fisheye, huber": lambda: refinement("fisheye", kernel="huber"),
    "refine_pose, detached": lambda: refinement(backward="detached"),
    "absolute": absolute,
    "relative": lambda: relative(weighted=False),
    "relative, essential, weighted": lambda: relative(weighted=True, model="essential"),
}


def gradients(function: Callable[..., Any], inputs: list[Tensor]) -> tuple[Tensor, ...]:
    """To all inputs, of what has one."""
    leaves = [x.clone().requires_grad_() for x in inputs]
    attached = [x.sin().sum() for x in function(*leaves) if x.requires_grad]
    return torch.autograd.grad(sum(attached), leaves, materialize_grads=True) if attached else ()


@pytest.mark.parametrize("name", CASES)
def test_a_graph_has_the_bits_of_the_eager_program(name: str) -> None:
    function, inputs = CASES[name]()
    graph = compiled(function)
    for x, y in zip(function(*inputs), graph(*inputs), strict=True):
        assert x.dtype == y.dtype
        assert torch.equal(x, y)
    expected = gradients(function, inputs)
    assert all(x.abs().max() > 0 for x in expected) or "detached" in name
    torch.testing.assert_close(gradients(graph, inputs), expected, rtol=1e-10, atol=1e-12)


def test_another_count_of_points_is_right_too() -> None:
    """Which a graph takes with sizes that are open."""
    function, inputs = absolute()
    graph = compiled(function)
    for count in (60, 50, 40):
        fewer = [x[:, :count] for x in inputs[:2]]
        for x, y in zip(function(*fewer, inputs[2]), graph(*fewer, inputs[2]), strict=True):
            assert torch.equal(x, y)


def test_autocast_changes_no_bit_of_a_graph() -> None:
    function, inputs = refinement()
    inputs = [x.float() for x in inputs]
    expected = function(*inputs)
    with torch.autocast("cpu", torch.bfloat16):
        for x, y in zip(expected, compiled(function)(*inputs), strict=True):
            assert torch.equal(x, y)


def test_what_no_graph_can_do_is_said() -> None:
    function, inputs = refinement(backward="unroll")
    with pytest.raises(Exception, match=r"can not be compiled|Observed exception"):
        compiled(function)(*inputs)
    function, inputs = refinement()
    leaves = [x.clone().requires_grad_() for x in inputs]
    with pytest.raises(RuntimeError, match="double backward"):
        torch.autograd.grad(compiled(function)(*leaves)[0].sum(), leaves, create_graph=True)[
            0
        ].sum().backward()


def test_minimal_solvers_are_graphs() -> None:
    rays, points = torch.nn.functional.normalize(normal(7, 3, 3), dim=-1), normal(7, 3, 3, seed=1)
    R, t, valid = p3p(rays, points)
    found = compiled(p3p)(rays, points)
    assert torch.equal(found[2], valid)
    torch.testing.assert_close((found[0][valid], found[1][valid]), (R[valid], t[valid]))


def test_five_point_is_a_graph_whose_number_of_rows_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch._dynamo.config, "capture_dynamic_output_shape_ops", True)
    x_1, x_2 = 0.3 * normal(6, 5, 2), 0.3 * normal(6, 5, 2, seed=1)
    for expected, found in zip(five_point(x_1, x_2), compiled(five_point)(x_1, x_2), strict=True):
        assert torch.equal(found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_default_backend_takes_them(name: str) -> None:
    function, inputs = CASES[name]()
    graph = compiled(function, "inductor")
    torch.testing.assert_close(graph(*inputs), function(*inputs))
    torch.testing.assert_close(gradients(graph, inputs), gradients(function, inputs))
