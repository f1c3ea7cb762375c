"""Whole runs by a rule for the noise, and the table of them: ratios to the hand-set rule, with intervals."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev

from experiments.common import table
from experiments.learned_weights.noise.graphs import opened
from torchslam import SLAM, evaluate, load_config
from torchslam.types import State

HAND, STATED, LIKELIHOOD, SHAPE, TRAJECTORY = "hand-set", "stated", "likelihood", "shape", "trajectory"
FRONT_END = "experiments.learned_weights.noise.model:Informed"
RULES = (HAND, STATED, LIKELIHOOD, SHAPE, TRAJECTORY)
"""hand-set: one noise per pyramid level, not stated. stated: the same noise, stated as information at half the size.
likelihood: learned on the other sequences. shape: likewise, but every image has the level of "stated" and the noise is
isotropic. trajectory: "shape", trained further by the trajectory errors of the other sequences."""
MIN_POSED = 0.95
"""Fraction of posed frames below which an ATE is not compared: it belongs to another, shorter path."""

STUDENT = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)
"""97.5 % quantile of Student's t, one to nine degrees of freedom."""


@dataclass(frozen=True)
class Outcome:
    """ate_m: of all posed frames; posed, frames: their number and that of the sequence's frames; uncertain: the number
    of those whose pose was returned as uncertain."""

    ate_m: float
    posed: int
    frames: int
    uncertain: int


def outcome_of(name: str, seed: int, weights: Path | None, file: Path) -> Outcome:
    """Run a sequence by the noise model in a file, or by the hand-set rule; the outcome is kept in `file`."""
    if file.exists():
        return Outcome(**json.loads(file.read_text()))
    overrides = [f"seed={seed}"]
    if weights is not None:
        overrides += [f"features.kind={FRONT_END}", f'features.weights="{weights}"']
    sequence = opened(name)
    assert sequence.groundtruth is not None
    run = SLAM(sequence.camera, load_config(None, overrides)).run(sequence)
    error = evaluate(run.trajectory, sequence.groundtruth).ate_m
    uncertain = sum(result.state is State.UNCERTAIN for result in run.results)
    outcome = Outcome(error, len(run.trajectory), len(sequence), uncertain)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(asdict(outcome)))
    return outcome


Runs = dict[str, dict[str, dict[int, Outcome]]]
"""Outcomes by sequence, rule and seed."""


def mean_log(numbers: Iterable[float]) -> float:
    return fmean(math.log(each) for each in numbers)


def geometric_mean(logs: Sequence[float]) -> str:
    """The mean ratio of logarithms, one of each sequence, with the 95 % interval of Student's t."""
    middle = fmean(logs)
    if len(logs) < 2:
        return f"{math.exp(middle):.3f}"
    reach = STUDENT[len(logs) - 2] * stdev(logs) / math.sqrt(len(logs))
    return f"{math.exp(middle):.3f} ({math.exp(middle - reach):.3f} to {math.exp(middle + reach):.3f})"


def is_whole(outcome: Outcome) -> bool:
    return outcome.posed >= MIN_POSED * outcome.frames


def run_table(runs: Runs) -> str:
    """Whole runs by each rule, and the ratio of their ATE to that of the hand-set rule with the same seeds."""
    logs: dict[str, dict[str, float]] = {}
    rows = []
    for name, cell in runs.items():
        hand = cell[HAND]
        for rule, found in cell.items():
            common = [
                seed for seed in found if seed in hand and is_whole(found[seed]) and is_whole(hand[seed])
            ]
            if common:
                pairs = [found[seed].ate_m / hand[seed].ate_m for seed in common]
                logs.setdefault(rule, {})[name] = mean_log(pairs)
            rows.append(
                [
                    name,
                    rule,
                    ", ".join(f"{1e3 * each.ate_m:.4g}" for each in found.values()),
                    f"{math.exp(logs[rule][name]):.3f}" if common and rule != HAND else "",
                    ", ".join(f"{each.posed}" for each in found.values()) + f" of {found[min(found)].frames}",
                    ", ".join(f"{each.uncertain}" for each in found.values()),
                ]
            )
    rows += [
        ["**all**", rule, "", geometric_mean(list(logs[rule].values())), "", ""]
        for rule in logs
        if rule != HAND
    ]
    return table(["sequence", "rule", "ATE (mm) by seed", "ratio", "posed", "uncertain"], rows)
