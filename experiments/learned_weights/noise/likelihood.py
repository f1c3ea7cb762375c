"""Whether what a keypoint shows predicts its residual better than one number per recording does. See README.md.

python -m experiments.learned_weights.noise.likelihood
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from experiments.common import parser_of, table, write_between
from experiments.learned_weights.noise.consistency import nees
from experiments.learned_weights.noise.cues import NAMES
from experiments.learned_weights.noise.densities import (
    at_number,
    interval,
    log_likelihoods,
    log_likelihoods_by_t,
    variance_of,
)
from experiments.learned_weights.noise.graphs import LEAST_KNOWN, Example
from experiments.learned_weights.noise.model import NoiseModel, constant
from experiments.learned_weights.noise.report import geometric_mean
from experiments.learned_weights.noise.run import SEEDS, SEQUENCES, Experiment
from experiments.learned_weights.noise.training import (
    BEND,
    Residuals,
    Settings,
    fit_residuals,
    residuals,
    solved,
    weighed,
)
from torchslam.geometry.gating import GATE_FACTOR

ROW = len(NAMES)
"""Column of the row of the image, after those of the cues."""
FOUR = (*map(NAMES.index, ("level", "contrast", "sharpness")), ROW)
"""Scale, contrast, blur and row: sharpness is low where an image is blurred."""
ELEVEN = tuple(range(ROW + 1))
RECORDINGS = (*SEQUENCES, "office_loop")
STATED = ("scale", "half scale", "half, by the run")
NUMBER, TAILS, ITSELF, HALVES = (
    "one number",
    "number, Student's t",
    "4, fitted to itself",
    "4, to its other half",
)
LEARNED = {"4 cues": FOUR, "11 cues": ELEVEN}
"""Fitted to the other recordings. In the tables a noise that is fitted is always times the recording's number."""


@dataclass(frozen=True)
class Recording:
    """example: a run at the minimum of its graph by scales; found: its residuals. Cues are differences from their mean
    over the recording; the row of the image comes last."""

    example: Example
    found: Residuals

    @classmethod
    def of(cls, example: Example) -> Recording:
        """Of the keyframes of a run."""
        rows = example.graph.pixels[:, 1:] / example.graph.camera.height
        values = torch.cat((example.values, rows), dim=-1)
        example = solved(replace(example, values=values - values.mean(0)))
        return cls(example, residuals(example, example))

    def seeing(self, cues: Sequence[int]) -> Recording:
        """With some of the cues."""
        cues = list(cues)
        example = replace(self.example, values=self.example.values[:, cues])
        return Recording(example, replace(self.found, values=self.found.values[:, cues]))


def fitted(recordings: Sequence[Residuals], seed: int) -> NoiseModel:
    """The function under which residuals are most likely once those of each recording are divided by its number."""
    settings, parts = Settings(seed=seed), []
    for each in recordings:
        deviation = variance_of(constant(1.0), each).sqrt()
        parts.append(replace(each, errors=each.errors / deviation).drawn(settings.observations, seed))
    found = Residuals.cat(parts)
    model = NoiseModel("isotropic", seed, found.values.shape[-1])
    model.standardize(found.values)
    fit_residuals(model, found, settings)
    return model


def models_of(test: str, recordings: dict[str, Recording], seed: int) -> dict[str, NoiseModel]:
    """Each noise of a recording."""
    found, variance = recordings[test].found, recordings[test].example.noise_variance
    stated = (1.0, GATE_FACTOR**2, GATE_FACTOR**2 / variance)
    models = {name: constant(level) for name, level in zip(STATED, stated, strict=True)}
    models[NUMBER] = at_number(constant(1.0), found)
    others = [recording for name, recording in recordings.items() if name != test]
    for rule, cues in LEARNED.items():
        model = fitted([recording.seeing(cues).found for recording in others], seed)
        models[rule] = at_number(model, recordings[test].seeing(cues).found)
    seen = recordings[test].seeing(FOUR).found
    return models | {ITSELF: at_number(fitted([seen], seed), seen)}


def gains_of(recording: Recording, models: dict[str, NoiseModel], seed: int) -> dict[str, Tensor]:
    """(n,) by how much each noise makes each error more likely than the recording's number does, in nats."""
    logs = {rule: log_likelihoods(each, seen_by(rule, recording).found) for rule, each in models.items()}
    found, logs[TAILS] = recording.seeing(FOUR).found, log_likelihoods_by_t(recording.found)
    logs[HALVES] = torch.empty_like(logs[NUMBER])
    second = found.frames >= len(recording.example.known) // 2
    for half in (second, ~second):
        model = at_number(fitted([found.at(~half)], seed), found)
        logs[HALVES][half] = log_likelihoods(model, found.at(half))
    return {rule: log - logs[NUMBER] for rule, log in logs.items()}


def seen_by(rule: str, recording: Recording) -> Recording:
    """A recording with the cues of a rule."""
    return recording.seeing(LEARNED.get(rule, FOUR))


def tables(recordings: dict[str, Recording], seeds: Sequence[int]) -> str:
    """How likely errors are, and NEES, by each noise."""
    likely, errors, means = [], [], []
    for name, recording in recordings.items():
        models = [models_of(name, recordings, seed) for seed in seeds]
        drawn = [gains_of(recording, each, seed) for each, seed in zip(models, seeds, strict=True)]
        gains = {
            rule: torch.stack([each[rule] for each in drawn]).mean(0) for rule in drawn[0] if rule != NUMBER
        }
        means.append({rule: float(each.mean()) for rule, each in gains.items()})
        ends = {
            rule: interval(each, recording.found.frames) for rule, each in gains.items() if rule not in STATED
        }
        cells = [
            f"{math.exp(mean):.3f}"
            + (" ({:.3f} to {:.3f})".format(*map(math.exp, ends[rule])) if rule in ends else "")
            for rule, mean in means[-1].items()
        ]
        deviation = variance_of(constant(1.0), recording.found).sqrt()
        numbers = f"{deviation:.2f}", f"{recording.example.noise_variance:.2f}"
        likely.append([name, f"{len(recording.found.frames)}", *numbers, *cells])
        if int(recording.example.known.sum()) >= LEAST_KNOWN:
            found = [fmean(nees_by(rule, recording, each[rule]) for each in models) for rule in models[0]]
            errors.append([name, f"{len(recording.example.known)}", *(f"{each:.1f}" for each in found)])
        print(likely[-1], errors[-1:], flush=True)
    rules = list(means[0])
    likely.append(
        ["**all**", "", "", "", *(geometric_mean([each[rule] for each in means]) for rule in rules)]
    )
    header = ["recording", "observations", "its number (scales)", "`noise_variance`", *rules]
    return f"{table(header, likely)}\n{table(['recording', 'keyframes', *models[0]], errors)}"


def nees_by(rule: str, recording: Recording, model: NoiseModel) -> float:
    """NEES of the keyframes after their graph is solved with a noise."""
    with torch.no_grad():
        example = solved(weighed(seen_by(rule, recording).example, model))
        return nees(example.graph, example.T_cw, example.known, BEND)


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--output", type=Path, default=Path("results") / "noise_model", metavar="DIR")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    experiment = Experiment(arguments.output)
    text = tables({name: Recording.of(experiment.example(name)) for name in RECORDINGS}, arguments.seeds)
    print(text, flush=True)
    if not arguments.no_readme:
        write_between(Path(__file__).parent / "README.md", text, "<!-- likelihood -->\n")


if __name__ == "__main__":
    main()
