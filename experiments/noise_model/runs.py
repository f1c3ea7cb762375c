"""Whole runs by a rule for the noise, and their figures."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from experiments.noise_model.consistency import consistency
from experiments.noise_model.graphs import LEAST_KNOWN, keyframes_of, opened, truth_of
from torchslam import SLAM, evaluate, load_config

FRONT_END = "experiments.noise_model.model:Informed"


@dataclass(frozen=True)
class Outcome:
    """ate_m of all posed frames; keyframes' nees and ratio as `Consistency` has them, None where too few are known."""

    ate_m: float
    posed: int
    frames: int
    nees: float | None
    ratio: float | None


def outcome_of(name: str, seed: int, weights: Path | None, file: Path) -> Outcome:
    """Of a run over a sequence by the noise model in a file, or by the hand-set rule; kept in `file`."""
    if file.exists():
        return Outcome(**json.loads(file.read_text()))
    overrides = [f"seed={seed}"]
    if weights is not None:
        overrides += [f"features.kind={FRONT_END}", f'features.weights="{weights}"']
    sequence = opened(name)
    assert sequence.groundtruth is not None
    run = SLAM(sequence.camera, load_config(None, overrides)).run(sequence)
    T_cw, known = truth_of(run.graph, sequence)
    graph, frames, _ = keyframes_of(run.graph)
    known = known[frames]
    found = consistency(graph, T_cw[frames], known) if int(known.sum()) >= LEAST_KNOWN else None
    file.parent.mkdir(parents=True, exist_ok=True)
    outcome = Outcome(
        evaluate(run.trajectory, sequence.groundtruth).ate_m,
        len(run.trajectory),
        len(sequence),
        found.nees if found else None,
        found.ratio if found else None,
    )
    file.write_text(json.dumps(asdict(outcome)))
    return outcome
