"""Derivatives of minimizers in both directions, twice, and under `torch.func`'s transforms, against one another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import jacfwd, jacrev, jvp, vmap

from tests.optim.conftest import adjusted, optimized, solved_graph
from tests.optim.test_pose_graph import make_scene
from tests.optim.test_run_graph import simulated
from torchslam.geometry import se3_exp, se3_inverse, sim3_exp, so3_exp
from torchslam.optim import PosePrior, solve_bundle
from torchslam.optim.run_graph import solve_graph

CONVERGED = {"iterations": 20, "tolerance": 0.0}
EXACT = {"rtol": 0.0, "atol": 1e-10}
Problem = tuple[Callable[[Tensor], Tensor], Tensor]


def pose_problem(pose_scene, model="pinhole", with_prior=False) -> Problem:
    scene = pose_scene(batch=2, count=6, noise=2.0, model=model, perturbation=0.005)
    eye = torch.eye(6, dtype=torch.float64).expand(2, 6, 6)

    def poses(x: Tensor) -> Tensor:
        """Of what all enter: pixels, points, weights, camera, scale and prior."""
        pixels = scene.pixels + x[:2]
        points = torch.cat((scene.points_w[:, :1] + 0.01 * x[None, None, 2:5], scene.points_w[:, 1:]), dim=1)
        weights = 1 + x[5].square() * torch.linspace(0, 1, 12, dtype=torch.float64).view(2, 6)
        camera = scene.camera.with_params(scene.camera.params * (1 + 0.01 * x[6]))
        prior = None
        if with_prior:
            prior = PosePrior(se3_exp(0.01 * x[:6]) @ scene.start, (1 + x[0]).square() * 400 * eye)
        return scene.solved(
            points_w=points,
            pixels=pixels,
            camera=camera,
            weights=weights,
            prior=prior,
            scale=2 + x[7],
            **CONVERGED,
        ).T_cw[:, :3]

    return poses, torch.linspace(-0.5, 0.5, 8, dtype=torch.float64)


def bundle_problem(bundle_scene, free_camera=False, **options) -> Problem:
    problem = bundle_scene(frames=3, points=10, noise=1.0, **options).problem

    def estimate(x: Tensor) -> Tensor:
        ramp = torch.linspace(-1, 1, len(problem.pixels), dtype=torch.float64)[:, None]
        solution = adjusted(
            replace(
                problem,
                T_cw=se3_exp(torch.nn.functional.pad(0.01 * x[:1], (0, 5))) @ problem.T_cw,
                pixels=problem.pixels + x[:2] * ramp,
                weights=1 + x[2] * ramp[:, 0].square(),
                camera=problem.camera.with_params(problem.camera.params * (1 + 0.01 * x[3])),
            ),
            free_camera=free_camera,
            kernel="cauchy",
            scale=3 + x[4],
            **CONVERGED,
        )
        parts = solution.T_cw[:, :3], solution.points_w, 1e-3 * solution.camera.params
        return torch.cat([part.flatten() for part in parts])

    return estimate, torch.linspace(-0.3, 0.4, 5, dtype=torch.float64)


def graph_problem() -> Problem:
    _, graph = simulated(frames=7, points=16)

    def poses(x: Tensor) -> Tensor:
        ramp = torch.linspace(-1, 1, len(graph.pixels), dtype=torch.float64)[:, None]
        moved = replace(
            graph,
            pixels=graph.pixels + x[:2] * ramp,
            weights=graph.weights * (1 + x[2] * ramp[:, 0].square()),
            camera=graph.camera.with_params(graph.camera.params * (1 + 0.01 * x[3])),
        )
        T_cw = solved_graph(moved, kernel="cauchy", scale=3.0, **CONVERGED).T_cw
        centers = se3_inverse(T_cw)[:, :3, 3] - se3_inverse(T_cw)[:1, :3, 3]  # of any scale
        return torch.cat((T_cw[:, :3, :3].flatten(), (centers / centers.norm()).flatten()))

    return poses, torch.linspace(-0.3, 0.4, 4, dtype=torch.float64)


def pose_graph_problem(with_scale=True) -> Problem:
    graph = make_scene(nodes=4, with_scale=with_scale).graph

    def nodes(x: Tensor) -> Tensor:
        twist = torch.nn.functional.pad(x[:3] * torch.ones(len(graph.edges), 1, dtype=torch.float64), (1, 3))
        twist = 0.01 * twist * torch.linspace(-1, 1, len(graph.edges), dtype=torch.float64)[:, None]
        start = sim3_exp(torch.nn.functional.pad(0.01 * x[:1], (0, 6))) @ graph.S_cw[:, :1]
        moved = replace(
            graph,
            S_cw=torch.cat((start, graph.S_cw[:, 1:]), dim=1),
            S_ji=sim3_exp(twist) @ graph.S_ji,
            information=graph.information * (1 + x[3].square()),
        )
        return optimized(moved, kernel="cauchy", scale=3 + x[4], iterations=100, tolerance=1e-26).S_cw[
            ..., :3, :
        ]

    return nodes, torch.linspace(-0.3, 0.4, 5, dtype=torch.float64)


def rotation_graph_problem() -> Problem:
    graph = make_scene(nodes=4, with_scale=False, information=None).graph

    def nodes(x: Tensor) -> Tensor:
        ramp = torch.linspace(-1, 1, len(graph.edges), dtype=torch.float64)[:, None]
        moved = replace(
            graph,
            S_cw=graph.S_cw[..., :3, :3],
            S_ji=so3_exp(0.1 * x[:3] * ramp) @ graph.S_ji[..., :3, :3],
            information=4e4 * (1 + x[3] * ramp.squeeze(-1)),
        )
        return optimized(moved, kernel="cauchy", scale=3 + x[4], iterations=100, tolerance=1e-26).S_cw

    return nodes, torch.linspace(-0.3, 0.4, 5, dtype=torch.float64)


@pytest.fixture(
    params=[
        "pose",
        "fisheye",
        "prior",
        "bundle",
        "free camera",
        "graph",
        "pose graph",
        "rigid pose graph",
        "rotation graph",
    ]
)
def problem(request, pose_scene, bundle_scene) -> Problem:
    makers: dict[str, Callable[[], Problem]] = {
        "pose": lambda: pose_problem(pose_scene),
        "fisheye": lambda: pose_problem(pose_scene, model="fisheye"),
        "prior": lambda: pose_problem(pose_scene, with_prior=True),
        "bundle": lambda: bundle_problem(bundle_scene),
        "free camera": lambda: bundle_problem(bundle_scene, free_camera=True),
        "graph": graph_problem,
        "pose graph": pose_graph_problem,
        "rigid pose graph": lambda: pose_graph_problem(with_scale=False),
        "rotation graph": rotation_graph_problem,
    }
    return makers[request.param]()


def penalty(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """A number that depends on all of the output, not linearly."""

    def of(x: Tensor) -> Tensor:
        value = function(x).flatten()
        return (value * torch.linspace(-1, 1, len(value), dtype=value.dtype)).square().sum()

    return of


def mixed(function: Callable[[Tensor], Tensor], count: int = 6) -> Callable[[Tensor], Tensor]:
    """A few sums over all of the output, each with weights of its own, as a Jacobian row by row takes long."""

    def of(x: Tensor) -> Tensor:
        value = function(x).flatten()
        return torch.cos(torch.arange(count * len(value), dtype=value.dtype)).view(count, -1) @ value

    return of


def test_second_order_gradients_by_gradcheck(problem):
    function, x = problem
    x = x.clone().requires_grad_()
    assert torch.autograd.gradgradcheck(function, (x,), eps=1e-4, atol=1e-7, rtol=1e-3, fast_mode=True)


def test_forward_and_reverse_mode_agree(problem):
    function, x = mixed(problem[0]), problem[1]
    expected = torch.autograd.functional.jacobian(function, x)
    for found in (jacrev(function)(x), jacfwd(function)(x)):
        torch.testing.assert_close(found, expected, **EXACT)
    change = torch.cos(torch.arange(len(x), dtype=x.dtype))
    torch.testing.assert_close(jvp(function, (x,), (change,))[1], expected @ change, **EXACT)
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(function(forward_ad.make_dual(x, change))).tangent
    torch.testing.assert_close(tangent, expected @ change, **EXACT)


def test_vmap_equals_a_loop(problem):
    function, x = problem
    batch = torch.stack((x, 0.5 * x.flip(0)))
    value, reverse, forward = (
        torch.stack([mapped(x) for x in batch]) for mapped in (function, jacrev(function), jacfwd(function))
    )
    torch.testing.assert_close(vmap(function)(batch), value, **EXACT)
    torch.testing.assert_close(vmap(jacrev(function))(batch), reverse, **EXACT)
    torch.testing.assert_close(vmap(jacfwd(function))(batch), forward, **EXACT)
    torch.testing.assert_close(jacrev(vmap(function))(batch)[1, ..., 1, :], reverse[1], **EXACT)


def test_second_derivatives_are_the_same_in_every_order(problem):
    function, x = problem
    loss = penalty(function)
    expected = torch.autograd.functional.hessian(loss, x)
    for found in (jacfwd(jacrev(loss))(x), jacrev(jacrev(loss))(x), jacrev(jacfwd(loss))(x)):
        torch.testing.assert_close(found, expected, **EXACT)
    with pytest.raises(RuntimeError, match="forward mode within forward mode"):
        jacfwd(jacfwd(loss))(x)


def test_failures_have_no_derivative_under_any_transform(pose_scene):
    scene = pose_scene(batch=2, count=20)
    start, mask = scene.start.clone(), torch.ones(2, 20, dtype=torch.bool)
    start[0, 0, 0] = torch.nan
    mask[1, 2:] = False

    def poses(pixels):
        refined = scene.solved(pixels=pixels, start=start, mask=mask)
        return refined.T_cw, refined.success

    T_cw, success = poses(scene.pixels)
    assert not success.any()
    assert torch.equal(T_cw[0], torch.eye(4, dtype=torch.float64))
    for transform in (jacrev, jacfwd):
        assert (transform(lambda x: poses(x)[0])(scene.pixels) == 0).all()


def test_a_start_that_is_not_finite_is_no_success(bundle_scene):
    problem = bundle_scene().problem
    T_cw = problem.T_cw.clone()
    T_cw[3, 0, 3] = torch.nan
    solution = solve_bundle(replace(problem, T_cw=T_cw))
    assert not solution.success
    assert solution.T_cw.isfinite().all()
    _, graph = simulated()
    T_cw = graph.T_cw.clone()
    T_cw[4, 0, 3] = torch.nan
    success = solve_graph(replace(graph, T_cw=T_cw)).success
    assert success.tolist() == [row != 4 for row in range(len(T_cw))]
