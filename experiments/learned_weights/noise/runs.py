"""Whole runs by a rule for the noise, and their errors."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from experiments.learned_weights.noise.graphs import opened
from torchslam import SLAM, evaluate, load_config

FRONT_END = "experiments.learned_weights.noise.model:Informed"


@dataclass(frozen=True)
class Outcome:
    """ate_m: of all posed frames; posed, frames: their number and that of the sequence's frames."""

    ate_m: float
    posed: int
    frames: int


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
    outcome = Outcome(error, len(run.trajectory), len(sequence))
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(asdict(outcome)))
    return outcome
