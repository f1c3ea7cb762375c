"""No solver returns something other than a minimum without saying so."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.optim.conftest import adjusted, camera_of, minimized, optimized
from torchslam.errors import ConvergenceError
from torchslam.geometry import se3_exp, se3_inverse, transform
from torchslam.optim import (
    POSE_OPTIONS,
    BundleProblem,
    PoseGraph,
    SolverReason,
    solve_bundle,
    solve_least_squares,
    solve_pose,
    solve_pose_graph,
)


def line_residual(slope: Tensor, x: Tensor, y: Tensor) -> Tensor:
    return torch.exp(slope * x) - y


def fit_line(batch: int = 3, **options):
    x = torch.linspace(0, 1, 10, dtype=torch.float64).expand(batch, 10)
    return minimized(line_residual, torch.zeros(batch, 1).double(), (x, torch.exp(0.8 * x)), **options)


def square_of_poses(**options) -> PoseGraph:
    S_cw = se3_exp(0.3 * torch.arange(24, dtype=torch.float64).view(4, 6).sin())
    edges = torch.tensor([(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)])
    S_ji = S_cw[edges[:, 1]] @ se3_inverse(S_cw[edges[:, 0]])
    S_ji = se3_exp(0.05 * torch.arange(30, dtype=torch.float64).view(5, 6).cos()) @ S_ji
    return PoseGraph(S_cw, edges, S_ji, with_scale=False, **options)


@pytest.fixture
def solvers(pose_scene, bundle_scene):
    """Each solver, on a problem that it solves."""
    pose, bundle, graph = pose_scene(), bundle_scene().problem, square_of_poses()
    return {
        "poses": lambda **options: pose.solved(**options),
        "bundle adjustments": lambda **options: adjusted(bundle, **options),
        "pose graphs": lambda **options: optimized(graph, **options),
        "elements": fit_line,
    }


@pytest.mark.parametrize("what", ["poses", "bundle adjustments", "pose graphs", "elements"])
def test_strict_raises_where_the_search_did_not_end(solvers, what):
    solve = solvers[what]
    unfinished, finished = solve(iterations=1), solve(strict=True)
    assert unfinished.success.all()  # determined, but not at the minimum
    assert not unfinished.converged.any()
    assert finished.converged.all()
    assert finished.converged.shape == finished.success.shape
    assert finished.reasons == [SolverReason.CONVERGED] * finished.success.numel()
    assert {*unfinished.reasons} == {SolverReason.ITERATION_LIMIT}
    with pytest.raises(ConvergenceError, match=rf"{what}: .* not converged"):
        solve(iterations=1, strict=True)


def test_elements_that_are_not_determined_are_named(pose_scene):
    scene = pose_scene(batch=4)
    mask = torch.ones(4, 40, dtype=torch.bool)
    mask[[1, 3], 2:] = False
    lost, right = SolverReason.UNDETERMINED, SolverReason.CONVERGED
    assert scene.solved(mask=mask).reasons == [right, lost, right, lost]
    assert str(lost).startswith("not determined: too few observations")
    strict = POSE_OPTIONS.replace(strict=True)
    with pytest.raises(ConvergenceError, match=r"of 4 poses: 2 not determined \(1, 3\)$"):
        solve_pose(
            scene.points_w, scene.pixels, T_cw=scene.start, camera=scene.camera, mask=mask, options=strict
        )
    with pytest.raises(ConvergenceError, match=r"of 50 elements: 50 not converged.* \(0, 1, .*9, \.\.\.\)"):
        fit_line(50, iterations=1, strict=True)


@pytest.mark.parametrize("perturbation", [pytest.param(0.01, marks=pytest.mark.slow), 0.04])
def test_solve_bundle_converges_at_its_defaults_with_a_fifth_of_outliers(bundle_scene, perturbation):
    def distances(problem, **options):
        solution = adjusted(problem, **options)
        centers = se3_inverse(solution.T_cw)[:, :3, 3]
        lengths = (centers[1:] - centers[:1]).norm(dim=-1)
        return solution, (lengths / lengths.sum()).square().sum()

    generator = torch.Generator().manual_seed(0)
    for seed in range(8):
        problem = bundle_scene(frames=6, points=60, seed=seed, perturbation=perturbation).problem
        bad = torch.rand(len(problem.pixels), generator=generator) < 0.2
        off = 30 * torch.randn(len(bad), 2, generator=generator, dtype=torch.float64)
        pixels = torch.where(bad[:, None], problem.pixels + off, problem.pixels).requires_grad_()
        problem = replace(problem, pixels=pixels)
        solution, loss = distances(problem)
        exact, exact_loss = distances(problem, iterations=1000, tolerance=1e-16)
        assert solution.converged
        assert exact.converged
        (gradient,), (right,) = (torch.autograd.grad(x, pixels) for x in (loss, exact_loss))
        assert (gradient - right).norm() < 0.01 * right.norm()


@pytest.mark.parametrize("parts", [1, 2])
def test_pose_graph_without_a_fixed_node_has_the_gradient_of_one_with_it(parts):
    """The first node of every connected part stays; a loss that does not depend on the gauge has one gradient."""

    def gradient(fixed):
        S_ji = square_of_poses().S_ji.repeat(parts, 1, 1).requires_grad_()
        one = square_of_poses()
        S_cw = torch.cat([one.S_cw] * parts)
        edges = torch.cat([one.edges + 4 * part for part in range(parts)])
        solution = solve_pose_graph(PoseGraph(S_cw, edges, S_ji, fixed=fixed, with_scale=False))
        assert solution.success
        between = solution.S_cw[1::4] @ se3_inverse(solution.S_cw[2::4])
        (found,) = torch.autograd.grad(between[:, 0, 3].sum(), S_ji)
        return solution, found

    solution, free = gradient(())
    assert solution.moved.tolist() == [False, True, True, True] * parts
    _, held = gradient(tuple(range(3, 4 * parts, 4)))
    assert free.abs().max() > 0.01
    torch.testing.assert_close(free, held)


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize(("motion", "determined"), [(0.3, True), (0.0, False)])
def test_a_window_without_parallax_is_no_success(motion, determined, batched):
    """A camera that turns on the spot: no depth, so no scale of its translation, and no gradient through either."""
    generator = torch.Generator().manual_seed(0)
    T_cw = se3_exp(0.05 * torch.randn(5, 6, generator=generator, dtype=torch.float64) * (torch.arange(6) > 2))
    T_cw[:, 0, 3] = motion * torch.arange(5)
    points_w = torch.rand(30, 3, generator=generator, dtype=torch.float64) + torch.tensor([-0.5, -0.5, 4.0])
    frame_index, point_index = torch.cartesian_prod(torch.arange(5), torch.arange(30)).unbind(-1)
    pixels = camera_of().project(transform(T_cw, points_w[None].expand(5, 30, 3)))[0].flatten(0, 1)
    pixels.requires_grad_()
    problem = BundleProblem(T_cw, points_w, frame_index, point_index, pixels, camera_of())
    if batched:
        problem = replace(problem, T_cw=T_cw.repeat(2, 1, 1, 1))
    solution = adjusted(problem, iterations=10)
    assert (solution.success == determined).all()
    (gradient,) = torch.autograd.grad(solution.points_w.square().sum() + solution.T_cw.sum(), pixels)
    assert (gradient.abs().max() > 0) == determined


def test_a_point_without_parallax_has_no_gradient_and_leaves_the_others_theirs(bundle_scene):
    """At 1e8 times the baseline its depth is noise; the gradient through it was 1e8 times that of the others."""
    scene = bundle_scene(points=30, noise=0.2)
    far = torch.tensor([1e7, 0.0, 1e8], dtype=torch.float64)
    scene.points_w[5], scene.problem.points_w[5] = far, far
    seen = scene.problem.point_index == 5
    exact = scene.problem.camera.project(
        transform(scene.T_cw[scene.problem.frame_index[seen]], far[None])[:, 0]
    )
    pixels = scene.problem.pixels.clone()
    pixels[seen] = exact[0]
    pixels.requires_grad_()
    solution = solve_bundle(replace(scene.problem, pixels=pixels))
    assert solution.success
    (through_far,) = torch.autograd.grad(solution.points_w[5].sum(), pixels, retain_graph=True)
    assert (through_far == 0).all()
    (gradient,) = torch.autograd.grad(solution.points_w.sum(), pixels)
    assert 0 < gradient.abs().max() < 1


def test_a_search_that_no_step_helps_has_given_up():
    """The residual is right at the start alone: every step makes it worse."""

    def residual(x, start):
        return torch.where(x == start, x, 10 + x.abs())

    start = torch.ones(1, 1).double()
    assert solve_least_squares(residual, start, (start,)).reasons == [SolverReason.GAVE_UP]
