"""Does a network that weighs matches, trained through the solver, give better poses? See README.md."""

from __future__ import annotations

import argparse
import math
import os
import re
from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor

from experiments.common import sequences, table, write_between
from experiments.match_weights.evaluation import (
    Learned,
    Method,
    candidates,
    choose,
    errors_of,
    relative_errors,
)
from experiments.match_weights.picture import draw
from experiments.match_weights.problems import Problems, make_problems
from experiments.match_weights.training import Settings, train
from experiments.match_weights.weighting import MatchWeights

HERE = Path(__file__).parent
CACHE = HERE / "results"
# Sequences and the share of their frames that a part takes.
TRAINING = {
    "redkitchen": (0.0, 0.5),
    "kitti07": (0.0, 0.5),
    "machine_hall": (0.0, 0.5),
}
UNSEEN = {
    "redkitchen": (0.5, 1.0),
    "kitti07": (0.5, 1.0),
    "machine_hall": (0.5, 1.0),
    "shelf_bin": (0.0, 1.0),
    "fr2_desk_20": (0.0, 1.0),
}
SMALL = Settings()
LARGE = Settings(steps=4000, batch=64, matches=256)
COMPETITORS = ("uniform weights", "best kernel", "RANSAC")


def problems_of(parts: dict[str, tuple[float, float]]) -> dict[str, Problems]:
    """The problems of parts of sequences, from the cache where they have been made before."""
    found = {}
    for name, (first, last) in parts.items():
        path = CACHE / f"{re.sub(r'[^a-z0-9_]', '_', name)}_{first:g}_{last:g}.pt"
        if not path.exists():
            for sequence in sequences([name]):
                whole = len(sequence)
                make_problems(sequence, range(round(first * whole), round(last * whole))).save(path)
        if path.exists():
            found[name] = Problems.load(path)
            print(f"{name} from {first:.0%} to {last:.0%}: {len(found[name])} problems", flush=True)
    return found


def report(
    unseen: dict[str, Problems], errors: dict[str, dict[str, Tensor]], methods: dict[str, Method]
) -> str:
    """The table of medians, what they come to, and the settings behind it; errors (P, 2) by part and method."""
    rows = []
    relative = {part: _relative(errors[part], unseen[part]) for part in unseen}
    for part, problems in unseen.items():
        cells = [_cell(errors[part][label]) for label in methods]
        best = min(relative[part][label] for label in COMPETITORS)
        which = "all of it" if UNSEEN[part] == (0.0, 1.0) else "second half"
        gain = f"{relative[part]['learned'] / best - 1:+.0%}"
        rows.append([f"{part}, {which}", f"{len(problems)}", *cells, gain])
    whole = {
        label: math.prod(relative[part][label] for part in unseen) ** (1 / len(unseen)) for label in methods
    }
    best = min(whole[label] for label in COMPETITORS)
    cells = [f"{1e3 * whole[label]:.2f}e-3" for label in methods]
    rows.append(["relative error, geometric mean", "", *cells, f"{whole['learned'] / best - 1:+.1%}"])
    header = ["unseen part", "problems", *methods, "learned against the best of the first three"]
    settings = [f"- {label}: {method}" for label, method in methods.items() if label != "learned"]
    return (
        table(header, rows)
        + "\nSettings, each the best of its kind on the training part:\n\n"
        + "\n".join(settings)
        + "\n"
    )


def _relative(errors: dict[str, Tensor], problems: Problems) -> dict[str, float]:
    """Median relative error by method."""
    return {label: float(relative_errors(error, problems).median()) for label, error in errors.items()}


def _cell(errors: Tensor) -> str:
    """Median errors (P, 2) in words."""
    metres, radians = errors.median(0).values.tolist()
    return f"{100 * metres:.2f} cm, {math.degrees(radians):.3f}°"


def evaluate(network: MatchWeights, training: dict[str, Problems], write: bool) -> None:
    """Compare with the competitors, their settings chosen on the training part, on what none of them has seen."""
    methods = {label: choose(options, training) for label, options in candidates().items()}
    methods["learned"] = Learned(network)
    unseen = problems_of(UNSEEN)
    errors = {
        part: {label: errors_of(method, problems) for label, method in methods.items()}
        for part, problems in unseen.items()
    }
    text = report(unseen, errors, methods)
    print(text)
    if write:
        write_between(HERE / "README.md", text)
        draw(HERE / "errors.png", errors)


def _mean_loss(history: list[float], first: float) -> float:
    """Over the tenth of the steps that begins at a share of them."""
    start = round(first * len(history))
    part = history[start : start + max(1, len(history) // 10)]
    return sum(part) / len(part)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--large", action="store_true", help="train longer, on more matches: for a GPU")
    parser.add_argument("--steps", type=int, help="of training")
    parser.add_argument("--no-readme", action="store_true", help="print the table, leave README and picture")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = LARGE if arguments.large else SMALL
    settings = replace(settings, steps=arguments.steps) if arguments.steps else settings
    distributed = "WORLD_SIZE" in os.environ
    if distributed:
        dist.init_process_group("gloo")
    first = not distributed or dist.get_rank() == 0
    if first:
        problems_of(TRAINING)
    if distributed:
        dist.barrier()
    training = problems_of(TRAINING)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = MatchWeights().to(device)
    history = train(network, Problems.cat(list(training.values())).to(device), settings)
    if first:
        tenths = (
            f"{_mean_loss(history, 0.0):.4f} in the first tenth, {_mean_loss(history, 0.9):.4f} in the last"
        )
        print(f"mean loss of {len(history)} steps: {tenths}", flush=True)
        torch.save(network.state_dict(), CACHE / "network.pt")
        evaluate(network.cpu(), training, write=not arguments.no_readme)
    if distributed:
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
