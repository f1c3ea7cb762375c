"""Weights that are inverse covariances, in refinement, bundle adjustment and the graph of a run."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.optim.conftest import adjusted, solved_graph
from tests.optim.test_run_graph import aligned_error, simulated
from torchslam.errors import TorchslamError
from torchslam.optim import POSE_OPTIONS, solve_bundle, solve_pose
from torchslam.optim.observation_graph import ObservationGraph

CONVERGED = {"iterations": 25, "tolerance": 0.0}


def matrices(generator, *shape):
    """Inverse covariances (..., 2, 2), some of them ten times as long as wide."""
    root = torch.randn(*shape, 2, 2, generator=generator, dtype=torch.float64)
    return root @ root.mT + 0.1 * torch.eye(2, dtype=torch.float64)


def isotropic(weights):
    return weights[..., None, None] * torch.eye(2, dtype=torch.float64)


@pytest.mark.parametrize("kernel", ["none", "cauchy"])
def test_a_weight_as_a_matrix_equals_the_scalar_weight(pose_scene, bundle_scene, model, kernel, generator):
    scene = pose_scene(outliers=0.1, model=model)
    weights = 0.5 + torch.rand(scene.pixels.shape[:2], generator=generator, dtype=torch.float64)
    one, other = (
        scene.solved(weights=w, kernel=kernel, scale=2.0, **CONVERGED) for w in (weights, isotropic(weights))
    )
    torch.testing.assert_close(one.T_cw, other.T_cw, atol=1e-9, rtol=0)
    torch.testing.assert_close(one.cost, other.cost)
    torch.testing.assert_close(one.covariance, other.covariance)
    problem = bundle_scene(noise=1.0, model=model).problem
    weights = 0.5 + torch.rand(len(problem.pixels), generator=generator, dtype=torch.float64)
    one, other = (
        adjusted(replace(problem, weights=w), kernel=kernel, scale=2.0, **CONVERGED)
        for w in (weights, isotropic(weights))
    )
    torch.testing.assert_close(one.T_cw, other.T_cw, atol=1e-7, rtol=0)
    torch.testing.assert_close(one.points_w, other.points_w, atol=1e-6, rtol=0)
    torch.testing.assert_close(one.covariance().frames, other.covariance().frames, rtol=1e-4, atol=1e-12)


def test_the_cost_sums_whitened_errors(pose_scene, generator):
    """And the answer is its minimum: no small motion lowers it."""
    scene = pose_scene(outliers=0.2)
    weights = matrices(generator, *scene.pixels.shape[:2])
    weights[:, 5] = 0.0
    weights[:, 6] = torch.tensor([[1.0, 2.0], [2.0, 1.0]])  # not definite
    refined = scene.solved(weights=weights, scale=2.0, **CONVERGED)
    T_cw = refined.T_cw.clone().requires_grad_()
    points_c = scene.points_w @ T_cw[:, :3, :3].mT + T_cw[:, None, :3, 3]
    errors = (scene.camera.project(points_c)[0] - scene.pixels)[..., None]
    squared = (errors.mT @ weights @ errors)[..., 0, 0]
    counted = torch.ones_like(squared).index_fill(1, torch.tensor([5, 6]), 0.0)
    cost = (counted * 2.0 * torch.log1p(squared / 4)).sum(-1)
    torch.testing.assert_close(refined.cost, cost.detach())
    (gradient,) = torch.autograd.grad(cost.sum(), T_cw)
    assert gradient[:, :3, 3].abs().max() < 1e-5


def test_gradients_reach_the_matrices(pose_scene, bundle_scene, generator):
    scene = pose_scene(batch=1, count=12, perturbation=1e-3)
    weights = matrices(generator, 1, 12).requires_grad_()

    def refined(pixels, weights):
        options = POSE_OPTIONS.replace(kernel="cauchy", scale=2.0, **CONVERGED)
        given = {"T_cw": scene.start, "camera": scene.camera, "weights": weights}
        return solve_pose(scene.points_w, pixels, **given, options=options).T_cw[:, :3]

    pixels = scene.pixels.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        refined, (pixels, weights), eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True
    )
    problem = bundle_scene(frames=5, points=15, noise=1.0, perturbation=1e-3).problem
    weights = matrices(generator, len(problem.pixels)).requires_grad_()

    def moved_by(pixels, weights, params):
        moved = replace(problem, pixels=pixels, weights=weights, camera=problem.camera.with_params(params))
        solution = adjusted(moved, kernel="cauchy", scale=2.0, **CONVERGED)
        return solution.T_cw[:, :3], solution.points_w

    leaves = (
        problem.pixels.clone().requires_grad_(),
        weights,
        problem.camera.params.clone().requires_grad_(),
    )
    assert torch.autograd.gradcheck(moved_by, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_vmap_over_matrices_is_the_same_as_a_loop(pose_scene, generator):
    scene = pose_scene(batch=2, count=15)
    weights = matrices(generator, 3, 2, 15)

    def refined(weights):
        return scene.solved(weights=weights).T_cw

    wanted = torch.stack([refined(each) for each in weights])
    torch.testing.assert_close(torch.func.vmap(refined)(weights), wanted, atol=1e-10, rtol=0)


def test_a_graph_with_matrices_is_saved_solved_and_differentiated(tmp_path, generator):
    truth, graph = simulated(noise=1.0)
    graph = replace(graph, weights=matrices(generator, len(graph.pixels)))
    graph.save(tmp_path / "graph")
    loaded = ObservationGraph.load(tmp_path / "graph")
    assert torch.equal(loaded.weights, graph.weights)

    def loss(weights):
        return aligned_error(
            solved_graph(replace(graph, weights=weights), kernel="cauchy", scale=2.0, **CONVERGED),
            truth,
        )

    leaf = graph.weights.clone().requires_grad_()
    loss(leaf).backward()
    direction = matrices(generator, len(graph.pixels)) - matrices(generator, len(graph.pixels))
    with torch.no_grad():
        expected = (loss(graph.weights + 1e-5 * direction) - loss(graph.weights - 1e-5 * direction)) / 2e-5
    torch.testing.assert_close((leaf.grad * direction).sum(), expected, rtol=1e-4, atol=0)
    bad = replace(graph, weights=-graph.weights)
    bad.save(tmp_path / "bad")
    with pytest.raises(TorchslamError, match="a negative weight"):
        ObservationGraph.load(tmp_path / "bad")


@pytest.mark.parametrize("solver", ["pose", "bundle"])
def test_a_covariance_is_that_of_the_solution_whatever_moves_in_place_later(pose_scene, bundle_scene, solver):
    covariances = []
    for moves in (False, True):
        if solver == "pose":
            scene = pose_scene()
            given = scene.points_w.clone(), scene.pixels.clone(), scene.camera.params.clone()
            solution = scene.solved(
                points_w=given[0], pixels=given[1], camera=scene.camera.with_params(given[2])
            )
        else:
            problem = bundle_scene().problem
            given = problem.points_w.clone(), problem.pixels.clone(), problem.camera.params.clone()
            camera = problem.camera.with_params(given[2])
            solution = solve_bundle(replace(problem, points_w=given[0], pixels=given[1], camera=camera))
        if moves:
            for tensor in given:
                tensor.mul_(1.3)
        covariances.append(solution.covariance if solver == "pose" else solution.covariance().frames)
    assert torch.equal(*covariances)
