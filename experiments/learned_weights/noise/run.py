"""Train noise models of keypoints and compare whole runs with them to the hand-set rule. See README.md.

python -m experiments.learned_weights.noise.run
"""

from __future__ import annotations

from pathlib import Path

import torch

from experiments.common import DATA_DIR, parser_of, publish
from experiments.learned_weights.noise.graphs import Example, example_of, opened
from experiments.learned_weights.noise.model import NoiseModel, constant, load, save
from experiments.learned_weights.noise.report import (
    HAND,
    LIKELIHOOD,
    RULES,
    SHAPE,
    STATED,
    Outcome,
    outcome_of,
    run_table,
)
from experiments.learned_weights.noise.training import Settings, at_level, fit_likelihood, fit_trajectories
from torchslam import load_config
from torchslam.geometry.gating import GATE_FACTOR

SEQUENCES = ("fr2_desk_20", "shelf_bin", "kitti07", "machine_hall", "drone", "redkitchen")
SEEDS = (0, 1, 2)
KINDS = {LIKELIHOOD: "directed", SHAPE: "isotropic"}
TAUGHT = ("fr2_desk_20", "shelf_bin", "kitti07", "machine_hall")
"""Sequences whose trajectory errors are trained on: the drone's keyframes have no true poses, and redkitchen's error
is not keypoint noise."""


class Experiment:
    """The runs, the models and the outcomes, each made once and kept in a folder."""

    def __init__(self, output: Path) -> None:
        self.output = output
        self._examples: dict[str, Example] = {}

    def example(self, name: str) -> Example:
        """The keyframes of a run by the hand-set rule."""
        if name not in self._examples:
            file = self.output / "examples" / f"{name}.pt"
            if not file.exists():
                print(f"running {name}", flush=True)
                file.parent.mkdir(parents=True, exist_ok=True)
                example_of(opened(name), load_config()).save(file)
            self._examples[name] = Example.load(file).keyframes_only
        return self._examples[name]

    def model(self, rule: str, test: str, seed: int) -> Path:
        """A file with the model of a rule, trained on all sequences but `test`."""
        file = self.output / "models" / f"{test}_{rule}_{seed}.safetensors"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            save(self._fitted(rule, test, seed), file)
        return file

    def _fitted(self, rule: str, test: str, seed: int) -> NoiseModel:
        settings = Settings(seed=seed)
        if rule == STATED:
            return constant(GATE_FACTOR**2)
        seen = {name: self.example(name) for name in SEQUENCES if name != test}
        if rule in KINDS:
            model = fit_likelihood(list(seen.values()), KINDS[rule], settings)
            return at_level(model, GATE_FACTOR**2) if rule == SHAPE else model
        taught = [seen[name] for name in TAUGHT if name in seen]
        return fit_trajectories(load(self.model(SHAPE, test, seed)), taught, settings)

    def outcome(self, rule: str, name: str, seed: int) -> Outcome:
        """The outcome of a whole run; seed: of the run and of the training."""
        weights = None if rule == HAND else self.model(rule, name, seed).absolute()
        return outcome_of(name, seed, weights, self.output / "outcomes" / f"{name}_{rule}_{seed}.json")


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--output", type=Path, default=Path("results") / "noise_model", metavar="DIR")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--sequences", nargs="+", choices=SEQUENCES, default=SEQUENCES)
    parser.add_argument("--rules", nargs="+", choices=RULES, default=RULES, help=f"{HAND} among them")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    missing = [name for name in SEQUENCES if not (DATA_DIR / name).exists() and name != "drone"]
    if missing:
        raise SystemExit(f"not at {DATA_DIR}: {', '.join(missing)}; each model is trained on all but one")
    experiment = Experiment(arguments.output)
    runs = {
        name: {
            rule: {seed: experiment.outcome(rule, name, seed) for seed in arguments.seeds}
            for rule in arguments.rules
        }
        for name in arguments.sequences
    }
    publish(run_table(runs), arguments, __file__)


if __name__ == "__main__":
    main()
