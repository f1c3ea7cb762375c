"""Graphs solved together: what each alone gives, with its own camera, whatever becomes of the others."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.optim.conftest import solved_graph
from tests.optim.test_run_graph import aligned_error, simulated, two_submaps
from torchslam.geometry import Camera
from torchslam.optim import GRAPH_OPTIONS, run_graph
from torchslam.optim.observation_graph import ObservationGraph
from torchslam.optim.run_graph import GraphSolution, solve_graph, solve_graphs

SIZES = ((10, 50, 0), (8, 40, 1), (7, 60, 2))
COLUMNS = ("T_cw", "points_w", "success", "moved_points", "converged", "submap", "timestamps")


def several(noise: float = 0.5) -> list[ObservationGraph]:
    """Of three sizes, each with a camera of its own, one of another size of image."""
    graphs = []
    for row, (frames, points, seed) in enumerate(SIZES):
        _, graph = simulated(noise, frames, points, seed)
        params = graph.camera.params.clone()
        params[:2] *= 1 + 0.01 * row
        size = (640, 480) if row else (1280, 960)
        graphs.append(replace(graph, camera=Camera(graph.camera.model, params, size)))
    return graphs


def assert_alike(found: GraphSolution, alone: GraphSolution) -> None:
    # Rounding may decide whether the last step below the tolerance is taken, which moves a pose by a billionth.
    for name in COLUMNS:
        torch.testing.assert_close(getattr(found, name), getattr(alone, name), atol=1e-8, rtol=0)
    assert found.camera.size == alone.camera.size
    assert torch.equal(found.camera.params, alone.camera.params)
    for bundle, other in zip(found.keyframes, alone.keyframes, strict=True):
        assert torch.equal(bundle.moved_frames, other.moved_frames)
        assert torch.equal(bundle.convergence.iterations, other.convergence.iterations)
        torch.testing.assert_close(bundle.cost, other.cost)
        for block, expected in zip(bundle.covariance(), other.covariance(), strict=True):
            torch.testing.assert_close(block, expected, rtol=1e-6, atol=1e-15)


def test_a_batch_of_different_graphs_equals_single_solves() -> None:
    graphs = several()
    for found, graph in zip(solve_graphs(graphs), graphs, strict=True):
        assert found.success.all()
        assert_alike(found, solve_graph(graph))


def test_one_graph_is_solved_to_the_same_bytes() -> None:
    (graph, *_) = several()
    (found,), alone = solve_graphs([graph]), solve_graph(graph)
    assert torch.equal(found.T_cw, alone.T_cw)
    assert torch.equal(found.points_w, alone.points_w)
    assert solve_graphs([]) == ()


def test_different_camera_models_and_weight_shapes_are_batched_separately() -> None:
    first, second, third = several()
    pinhole = Camera("pinhole", second.camera.params[:4], second.camera.size)
    matrices = third.weights[:, None, None] * torch.eye(2, dtype=torch.float64)
    graphs = [first, replace(second, camera=pinhole), replace(third, weights=matrices), third, first]
    for found, graph in zip(solve_graphs(graphs), graphs, strict=True):
        assert_alike(found, solve_graph(graph))


def test_submaps_of_a_graph_stay_separate() -> None:
    _, (one, _), both = two_submaps()
    found = solve_graphs([one, both, one])
    assert_alike(found[0], solve_graph(one))
    assert_alike(found[1], solve_graph(both))
    shared = both.point_index.clone()
    shared[both.frame_index == 10] = 0
    with pytest.raises(ValueError, match="seen in two submaps"):
        solve_graphs([one, replace(both, point_index=shared)])
    with pytest.raises(ValueError, match="no keyframe"):
        solve_graphs([one, replace(one, is_keyframe=torch.zeros(10, dtype=torch.bool))])


def test_convergence_is_reported_per_graph_and_submap() -> None:
    (*_, apart), (graph, *_) = two_submaps(), several()
    ends = solve_graph(apart)
    there = replace(apart, T_cw=ends.T_cw, points_w=ends.points_w)
    second = (apart.submap == 1)[:, None, None]
    half = replace(there, T_cw=torch.where(second, apart.T_cw, there.T_cw))
    found = solve_graphs([graph, half, there], options=GRAPH_OPTIONS.replace(iterations=2))
    assert [bool(each.converged.any()) for each in found] == [False, True, True]
    assert torch.equal(found[1].converged, apart.submap == 4)
    assert found[2].converged.all()
    for each, alone in zip(found, (graph, half, there), strict=True):
        assert torch.equal(each.converged, solved_graph(alone, iterations=2).converged)


@pytest.mark.parametrize("kernel", ["huber", "cauchy"])
def test_gradients_in_a_batch_equal_those_of_single_solves(kernel: str) -> None:
    graphs = several(noise=1.0)
    truths = [simulated(1.0, frames, points, seed)[0] for frames, points, seed in SIZES]

    def gradients(together: bool) -> list[Tensor]:
        leaves, moved = [], []
        for graph in graphs:
            own = [x.clone().requires_grad_() for x in (graph.pixels, graph.weights, graph.camera.params)]
            camera = graph.camera.with_params(own[2])
            moved.append(replace(graph, pixels=own[0], weights=own[1], camera=camera))
            leaves += own
        found = (
            solve_graphs(moved, options=GRAPH_OPTIONS.replace(kernel=kernel))
            if together
            else [solved_graph(graph, kernel=kernel) for graph in moved]
        )  # type: ignore[arg-type]
        loss = sum(aligned_error(one, truth) for one, truth in zip(found, truths, strict=True))
        return list(torch.autograd.grad(loss, leaves))  # type: ignore[arg-type]

    for found, alone in zip(gradients(True), gradients(False), strict=True):
        torch.testing.assert_close(found, alone, rtol=1e-8, atol=1e-9 * float(alone.abs().max()))


def test_a_failed_graph_does_not_affect_the_others() -> None:
    first, second, third = several()
    T_cw = second.T_cw.clone()
    T_cw[second.is_keyframe] = torch.nan
    blind = replace(third, weights=torch.zeros_like(third.weights))
    pixels = first.pixels.clone().requires_grad_()
    graphs = [replace(first, pixels=pixels), replace(second, T_cw=T_cw), blind, first]
    found = solve_graphs(graphs)
    assert [bool(one.success.any()) for one in found] == [True, False, False, True]
    assert [bool(one.keyframes[0].success) for one in found] == [True, False, False, True]
    assert_alike(found[3], solve_graph(first))
    torch.testing.assert_close(found[0].T_cw, found[3].T_cw, atol=1e-12, rtol=0)
    sum(one.T_cw.nan_to_num().sum() for one in found).backward()  # type: ignore[union-attr]
    assert pixels.grad is not None
    assert pixels.grad.isfinite().all()
    assert (pixels.grad != 0).any()


def test_padding_is_bounded_by_a_few_times_the_graph_size(monkeypatch: pytest.MonkeyPatch) -> None:
    small = [simulated(0.5, 6, 20, seed)[1] for seed in range(3)]
    large = [simulated(0.5, 10, 200, seed)[1] for seed in range(2)]
    graphs = [large[0], *small, large[1]]
    expected = [solve_graph(graph) for graph in graphs]
    batches = []
    adjust = run_graph.solve_bundle

    def counting(problem, **options):  # type: ignore[no-untyped-def]
        batches.append(tuple(problem.points_w.shape[:2]))
        return adjust(problem, **options)

    monkeypatch.setattr(run_graph, "solve_bundle", counting)
    for found, alone in zip(solve_graphs(graphs), expected, strict=True):
        assert_alike(found, alone)
    assert sorted((count, points > 100) for count, points in batches) == [(2, True), (3, False)]
