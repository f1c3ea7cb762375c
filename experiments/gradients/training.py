"""A step of training over three graphs of 24 frames: with learned weights and offsets, and with a learned factor too.

    python -m experiments.gradients.training [--output FILE] [--rooms FOLDER]

The rooms, the module and the loss are those of `examples/research.py`; the loss of a step is the mean of all three.
Rooms are mapped on the first call and kept in the folder. CPU time of one thread, of every step, from each of three
starts of the search. Prints a table and writes it to FILE and into docs/gradients.md, without --no-page.
"""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import NamedTuple

import torch

from examples.research import OPTIONS, RATE, TRAIN, Corrections, Example, prepared
from experiments.common import parser_of, publish_page, table, timed, write_between
from torchslam import GraphSolution
from torchslam.evaluation import ate

HERE = Path(__file__).parent
GRADIENTS = HERE.parents[1] / "docs" / "gradients.md"
START, END = "<!-- training -->\n", "<!-- end of training -->"
STEPS, PART = 30, 10


class Step(NamedTuple):
    """CPU milliseconds, the iterations of each graph, and the mean of the logarithms of the ATE."""

    ms: float
    iterations: list[int]
    loss: float


def train(rooms: list[Example], has_factor: bool, is_warm: bool) -> list[Step]:
    """Train a module of its own."""
    torch.manual_seed(0)
    module = Corrections()
    optimizer = torch.optim.Adam(module.parameters(), RATE)
    last: list[GraphSolution | None] = [None] * len(rooms)

    def step() -> tuple[list[int], float]:
        optimizer.zero_grad()
        iterations, losses = [], []
        for number, room in enumerate(rooms):
            found = module.solve(room, start=last[number] if is_warm else None, has_factor=has_factor)
            loss = ate(T_cw=found.T_cw, T_cw_groundtruth=room.T_cw).log() / len(rooms)
            loss.backward()
            last[number] = found
            iterations.append(int(found.keyframes[0].convergence.iterations))
            losses.append(float(loss.detach()))
        optimizer.step()
        return iterations, sum(losses)

    steps = []
    for _ in range(STEPS):
        (iterations, loss), spent = timed(step)
        steps.append(Step(spent, iterations, loss))
    return steps


def row(what: str, steps: list[Step]) -> list[str]:
    """Medians of the steps after the first, at the begin and at the end, and the iterations."""
    begin, end = steps[1 : 1 + PART], steps[-PART:]
    of_parts = (f"{statistics.median(step.ms for step in part) / 1e3:.2f}" for part in (begin, end))
    every = sorted(count for step in steps[1:] for count in step.iterations)
    iterations = f"{statistics.median(every):.0f} ({every[0]} to {every[-1]})"
    return [what, f"{steps[0].ms / 1e3:.2f}", *of_parts, iterations, f"{steps[-1].loss - steps[0].loss:.2f}"]


def main() -> None:
    parser = parser_of(__doc__, HERE / "training.md")
    parser.add_argument("--rooms", type=Path, default=Path("results/research"), help="default: %(default)s")
    parser.add_argument("--no-page", action="store_true", help="leave docs/gradients.md as it is")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.rooms.mkdir(parents=True, exist_ok=True)
    rooms = [prepared(seed, OPTIONS, arguments.rooms) for seed in TRAIN]
    rows = []
    for has_factor in (False, True):
        for is_warm in (False, True):
            what = "weights, offsets and a factor" if has_factor else "weights and offsets"
            what += ", warm start" if is_warm else ", start of the run"
            rows.append(row(what, train(rooms, has_factor, is_warm)))
    found = table(
        f"what is learned | first step, s | steps 2 to {PART + 1} | last {PART} of {STEPS} | iterations of a graph | "
        "change of log ATE",
        rows,
    )
    graphs = [room.graph for room in rooms]
    sizes = ", ".join(
        f"{int(graph.is_keyframe.sum())} keyframes with {len(graph.pixels)} observations of all frames"
        for graph in graphs
    )
    text = (
        f"Three graphs of {len(graphs[0].T_cw)} frames ({sizes}). CPU seconds of one thread, medians; a step "
        "solves and differentiates all three.\n\n    python -m experiments.gradients.training\n\n"
    )
    publish_page("A step of training", text + found, arguments)
    if not arguments.no_page:
        write_between(GRADIENTS, found, START, END)


if __name__ == "__main__":
    main()
