"""Does a learned model of keypoints' noise give better trajectories than one noise per level does? See README.md."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from experiments.common import DATA_DIR, write_between
from experiments.noise_model.graphs import Example, example_of, opened
from experiments.noise_model.model import NoiseModel, constant, load, save
from experiments.noise_model.picture import draw
from experiments.noise_model.report import (
    HAND,
    LEVEL,
    LIKELIHOOD,
    OWN,
    RULES,
    SHAPE,
    STATED,
    TRAJECTORY,
    graph_table,
    run_table,
)
from experiments.noise_model.runs import Outcome, outcome_of
from experiments.noise_model.same_graph import Figures, figures_of
from experiments.noise_model.training import Settings, at_level, fit_likelihood, fit_trajectories
from torchslam import load_config
from torchslam.geometry.gating import MARGIN

HERE = Path(__file__).parent
SEQUENCES = ("fr2_desk_20", "shelf_bin", "kitti07", "machine_hall", "drone", "redkitchen")
ROOM = "synthetic:room?frames=120&seed=2&noise=8&blur=0.8&exposure=0.3"
"""Rendered, with the truth and the camera exact; never trained on."""
SEEDS = (0, 1, 2)
RUN_RULES = (HAND, STATED, LIKELIHOOD, SHAPE, TRAJECTORY)
KINDS = {LEVEL: "constant", LIKELIHOOD: "directed", SHAPE: "isotropic"}
TAUGHT = ("fr2_desk_20", "shelf_bin", "kitti07", "machine_hall")
"""By whose trajectories models learn: the drone's keyframes have no true poses, and redkitchen's error is not the noise
of its keypoints, see the table."""
WITHOUT_TRUTH = ("drone",)
"""At keyframes: their own trajectories teach nothing."""


class Experiment:
    """The runs, the models and the figures, each made once and kept in a folder."""

    def __init__(self, output: Path, names: tuple[str, ...] = SEQUENCES) -> None:
        self.output, self.names = output, names
        self._examples: dict[str, Example] = {}

    def example(self, name: str) -> Example:
        """The run by the hand-set rule, its keyframes alone."""
        if name not in self._examples:
            file = self.output / "examples" / f"{short(name)}.pt"
            if not file.exists():
                print(f"running {name}", flush=True)
                file.parent.mkdir(parents=True, exist_ok=True)
                example_of(opened(name), load_config()).save(file)
            self._examples[name] = Example.load(file).keyframes_only
        return self._examples[name]

    def model(self, rule: str, test: str, seed: int) -> Path:
        """A file with the model of a rule that has seen all sequences but `test`."""
        file = self.output / "models" / f"{short(test)}_{short(rule)}_{seed}.safetensors"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            save(self._fitted(rule, test, seed), file)
        return file

    def _fitted(self, rule: str, test: str, seed: int) -> NoiseModel:
        settings = Settings(seed=seed)
        if rule == STATED:
            return constant(MARGIN**2)
        seen = {name: self.example(name) for name in self.names if name != test}
        if rule in (LEVEL, LIKELIHOOD, SHAPE):
            model = fit_likelihood(list(seen.values()), KINDS[rule], settings)
            return at_level(model, MARGIN**2) if rule == SHAPE else model
        taught = [self.example(test)] if rule == OWN else [seen[name] for name in TAUGHT if name in seen]
        return fit_trajectories(load(self.model(SHAPE, test, seed)), taught, settings)

    def outcome(self, rule: str, name: str, seed: int) -> Outcome:
        """Of a whole run; seed: of the run and of the training."""
        weights = None if rule == HAND else self.model(rule, name, seed).absolute()
        return outcome_of(name, seed, weights, self.place("outcomes", rule, name, seed))

    def figures(self, rule: str, name: str, seed: int) -> Figures:
        """Of the graph of the run by the hand-set rule, solved anew."""
        model = None if rule == HAND else load(self.model(rule, name, seed))
        return figures_of(self.example(name), model, self.place("figures", rule, name, seed))

    def place(self, kind: str, rule: str, name: str, seed: int) -> Path:
        """Where the figures of a graph or the outcome of a run are kept."""
        return self.output / kind / f"{short(name)}_{short(rule)}_{seed}.json"


def short(text: str) -> str:
    """For the name of a file."""
    return "".join(each if each.isalnum() else "-" for each in text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results") / "noise_model", metavar="DIR")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument(
        "--kept", action="store_true", help="tables of what is in DIR already; nothing is run"
    )
    parser.add_argument("--no-readme", action="store_true", help="print only")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    missing = [name for name in SEQUENCES if not (DATA_DIR / name).exists() and name != "drone"]
    if missing:
        raise SystemExit(f"not at {DATA_DIR}: {', '.join(missing)}; every model has seen all but one of them")
    experiment, names = Experiment(arguments.output), (*SEQUENCES, ROOM)

    def seeds_of(kind: str, rule: str, name: str) -> list[int]:
        if rule == OWN and name in WITHOUT_TRUTH:
            return []
        seeds = arguments.seeds[:1] if kind == "figures" and rule == HAND else arguments.seeds
        return [
            seed for seed in seeds if not arguments.kept or experiment.place(kind, rule, name, seed).exists()
        ]

    by_graph = {
        name: {
            rule: {seed: experiment.figures(rule, name, seed) for seed in seeds_of("figures", rule, name)}
            for rule in RULES
        }
        for name in names
    }
    print(text := graph_table(by_graph), flush=True)
    by_run = {
        name: {
            rule: {seed: experiment.outcome(rule, name, seed) for seed in seeds_of("outcomes", rule, name)}
            for rule in RUN_RULES
        }
        for name in SEQUENCES
    }
    print(more := run_table(by_run), flush=True)
    if not arguments.no_readme:
        write_between(HERE / "README.md", text + "\n" + more)
        draw({name: experiment.example(name) for name in names}, HERE / "noise.png")


if __name__ == "__main__":
    main()
