"""Is the gradient of a whole run right where the run has the readout of a rolling shutter? See README.md."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from experiments.common import parser_of, sequences
from experiments.run_gradient.run import graph_of, truth_of
from torchslam.data import Sequence
from torchslam.evaluation import ate
from torchslam.geometry.rolling_shutter import Readout
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.run_graph import solve_graph

EXACT = GRAPH_OPTIONS.replace(tolerance=0.0, iterations=12)
KINECT = Readout.known(0.028, 0.001)
"""For runs that are too short to find one."""


def check(sequence: Sequence) -> None:
    """Print derivatives of the ATE (mm) along directions: by one backward pass, by central differences."""
    graph = graph_of(sequence)
    T_cw, known = truth_of(graph, sequence)
    readout, calibration = graph.readout or KINECT, graph.calibration
    assert calibration is not None, "the run has an exact camera"

    def error(inputs: list[Tensor]) -> Tensor:
        pixels, weights, params, seconds = inputs
        changed = replace(
            graph,
            pixels=pixels,
            weights=weights,
            calibration=replace(calibration, camera=calibration.camera.with_params(params)),
            readout=replace(readout, seconds=seconds),
        )
        solved = solve_graph(changed, options=EXACT).T_cw
        return ate(T_cw=solved[known], T_cw_groundtruth=T_cw[known])

    inputs = [graph.pixels, graph.weights, calibration.camera.params, readout.seconds]
    noise = torch.randn(inputs[0].shape, generator=torch.Generator().manual_seed(1), dtype=inputs[0].dtype)
    focal = torch.zeros_like(inputs[2])
    focal[:2] = 1.0
    factors = noise[:, 0].reshape(-1, *[1] * (inputs[1].ndim - 1))
    leaves = [each.clone().requires_grad_() for each in inputs]
    gradients = torch.autograd.grad(error(leaves), leaves)
    for name, row, along, step in (
        ("all keypoints, at random by 1 px", 0, noise, 1e-4),
        ("all weights, at random by 10 %", 1, 0.1 * factors * inputs[1], 1e-3),
        ("given fx and fy, by 1 px", 2, focal, 1e-2),
        ("readout, by 1 ms", 3, torch.full_like(inputs[3], 1e-3), 1e-1),
    ):
        analytic, ends = float((gradients[row] * along).sum()), []
        for sign in (1, -1):
            moved = [each + sign * step * along if at == row else each for at, each in enumerate(inputs)]
            with torch.no_grad():
                ends.append(float(error(moved)))
        numeric = (ends[0] - ends[1]) / (2 * step)
        print(
            f"{name} | {1e3 * analytic:.6g} | {1e3 * numeric:.6g} | {abs(analytic / numeric - 1):.1e}",
            flush=True,
        )


def main() -> None:
    """Check the runs of the sequences that are there."""
    parser = parser_of(__doc__)
    parser.add_argument("name", nargs="?", default="fr2_desk_20")
    torch.set_num_threads(1)
    for sequence in sequences([parser.parse_args().name]):
        check(sequence)


if __name__ == "__main__":
    main()
