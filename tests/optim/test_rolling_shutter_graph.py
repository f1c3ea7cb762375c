"""Graphs of a rolling shutter: their minimum is right, and so is its gradient; files keep the readout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rolling_scene import CAMERA, FRAME_RATE, recording
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.optim.conftest import solved_graph
from torchslam.errors import TorchslamError
from torchslam.evaluation import ate
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.rolling_shutter import Readout
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.observation_graph import ObservationGraph
from torchslam.optim.run_graph import GraphSolution, solve_graph, solve_graphs

DETACHED = GRAPH_OPTIONS.replace(backward="detached")
READOUT = 0.9  # frame intervals


def rolling(seed: int = 0, frames: int = 40, points: int = 120) -> ObservationGraph:
    """A graph that knows its readout, with the true poses as a start."""
    graph = recording(READOUT, seed, frames=frames, points=points)
    return replace(graph, readout=Readout.known(READOUT / FRAME_RATE, 0.001))


def error(solution: GraphSolution, graph: ObservationGraph) -> Tensor:
    """ATE of the poses, of which those of the graph are the true ones."""
    return ate(T_cw=solution.T_cw, T_cw_groundtruth=graph.T_cw)


@pytest.mark.parametrize("held", [True, False])
def test_poses_are_those_of_the_middle_rows(held: bool) -> None:
    """As good as those of a global shutter, and far better than without the readout, whose focal length is wrong."""
    calibration = None if held else CameraMeasurement.of(CAMERA, 0.05)
    graph = replace(rolling(), calibration=calibration)
    without = replace(graph, readout=None)
    best = replace(recording(0.0), calibration=calibration)
    found, bent, ideal = (solve_graph(each, options=DETACHED) for each in (graph, without, best))
    assert bool(found.success.all() & found.converged.all())
    assert float(error(found, graph)) < 1.3 * float(error(ideal, graph))
    assert float(error(bent, graph)) > 4 * float(error(ideal, graph))
    assert float(found.camera.focal) == pytest.approx(400.0, rel=0.002)


def test_the_minimum_does_not_depend_on_the_start() -> None:
    graph = rolling()
    once = solve_graph(graph, options=DETACHED)
    moved = replace(graph, T_cw=once.T_cw, points_w=once.points_w)
    again = solve_graph(moved, options=DETACHED)
    torch.testing.assert_close(again.T_cw, once.T_cw, rtol=0.0, atol=1e-5)


def test_gradients_agree_with_solving_again() -> None:
    """Along a random direction of the pixels, the weights and the prior of the camera, and along the readout."""
    graph = rolling(frames=9, points=40)
    calibration, known, truth = CameraMeasurement.of(CAMERA, 0.02), graph.readout, graph
    assert known is not None
    generator = torch.Generator().manual_seed(3)
    inputs = [graph.pixels, graph.weights, CAMERA.params, known.seconds]
    random = [torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in inputs]
    random[2][4:] = 0.0  # distortions are not pixels
    none = [torch.zeros_like(x) for x in inputs]

    def loss(pixels: Tensor, weights: Tensor, params: Tensor, seconds: Tensor) -> Tensor:
        changed = replace(
            graph,
            pixels=pixels,
            weights=weights,
            calibration=replace(calibration, camera=CAMERA.with_params(params)),
            readout=replace(known, seconds=seconds),
        )
        solution = solved_graph(changed, tolerance=0.0, iterations=12)
        assert bool(solution.success.all())
        return error(solution, truth)

    leaves = [x.clone().requires_grad_() for x in inputs]
    gradients = torch.autograd.grad(loss(*leaves), leaves)
    for direction in ([*random[:3], none[3]], [*none[:3], torch.full_like(none[3], 0.01)]):
        step = 1e-4
        with torch.no_grad():
            ends = [
                float(loss(*(x + sign * step * d for x, d in zip(inputs, direction, strict=True))))
                for sign in (1, -1)
            ]
        expected = sum(float((g * d).sum()) for g, d in zip(gradients, direction, strict=True))
        assert expected == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5)


def test_graphs_of_both_shutters_are_solved_together() -> None:
    graphs = [rolling(frames=16), recording(0.0, 1, frames=16), rolling(seed=2, frames=16)]
    for graph, found in zip(graphs, solve_graphs(graphs, options=DETACHED), strict=True):
        torch.testing.assert_close(found.T_cw, solve_graph(graph, options=DETACHED).T_cw, rtol=0.0, atol=1e-8)


def test_a_file_keeps_the_readout(tmp_path: Path) -> None:
    graph = rolling(frames=16)
    graph.save(tmp_path / "graph")
    read = ObservationGraph.load(tmp_path / "graph")
    assert read.readout == graph.readout
    assert torch.equal(read.pixels, graph.pixels)
    replace(graph, readout=None).save(tmp_path / "global")
    assert ObservationGraph.load(tmp_path / "global").readout is None


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ([0.03, 0.001, 0.0], "not four float64"),
        ([float("nan"), 0.001, 0.0, 0.03], "not finite"),
        ([0.03, 0.001, 2e4, 0.03], "above 10000 s"),
        ([0.03, -0.001, 0.0, 0.03], "negative standard deviation"),
    ],
)
def test_a_wrong_readout_in_a_file_is_named(tmp_path: Path, numbers: list[float], words: str) -> None:
    path = tmp_path / "graph"
    rolling(frames=16).save(path)
    tensors = load_file(path) | {"readout": torch.tensor(numbers, dtype=torch.float64)}
    save_file(tensors, path, {"camera_model": CAMERA.model, "camera_size": "640 480"})
    with pytest.raises(TorchslamError, match=words):
        ObservationGraph.load(path)
