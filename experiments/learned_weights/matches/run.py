"""Train a network that weighs matches through the pose solver, and compare it with fixed kernels. See README.md.

python -m experiments.learned_weights.matches.run
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import torch

from experiments.common import CONTROL, parser_of, part_of, publish, sequences
from experiments.learned_weights.matches.evaluation import (
    Learned,
    Method,
    Oracle,
    candidates,
    choose,
    poses_of,
)
from experiments.learned_weights.matches.problems import Problems, make_problems
from experiments.learned_weights.matches.reference import reference_poses
from experiments.learned_weights.matches.report import PartResult, error_table
from experiments.learned_weights.matches.training import Settings, train
from experiments.learned_weights.matches.weighting import MatchWeights

RENDERED = "synthetic:"
CACHE = Path(__file__).parent / "results"
# Sequences and the range of their frames, as fractions.
TRAINING = {
    "redkitchen": (0.0, 0.5),
    "kitti07": (0.0, 0.5),
    "machine_hall": (0.0, 0.5),
    "synthetic:room": (0.0, 1.0),
    "synthetic:room?frames=120&seed=1&noise=5&blur=1.0": (0.0, 1.0),
}
UNSEEN = {
    "redkitchen": (0.5, 1.0),
    "kitti07": (0.5, 1.0),
    "machine_hall": (0.5, 1.0),
    "shelf_bin": (0.0, 1.0),
    "fr2_desk_20": (0.0, 1.0),
}
SEEDS = (0, 1, 2)


def problems_of(parts: dict[str, tuple[float, float]]) -> dict[str, Problems]:
    """The problems of parts of sequences, read from the cache where they exist."""
    found = {}
    for name, share in parts.items():
        first, last = share
        path = CACHE / f"{re.sub(r'[^a-z0-9_]', '_', name)}_{first:g}_{last:g}.pt"
        if not path.exists():
            for sequence in sequences([name]):
                make_problems(sequence, part_of(sequence, share), reference_poses(sequence, CACHE)).save(path)
        if path.exists():
            found[name] = Problems.load(path)
            print(f"{name} from {first:.0%} to {last:.0%}: {len(found[name])} problems", flush=True)
    return found


def evaluate(
    networks: list[MatchWeights],
    training: dict[str, Problems],
    unseen: dict[str, Problems],
    control: dict[str, Problems],
) -> str:
    """The tables; competitors choose their settings on the real training parts."""
    real = [part for name, part in training.items() if not name.startswith(RENDERED)]
    chosen = {label: choose(options, real) for label, options in candidates().items()}
    methods: dict[str, list[Method]] = {label: [method] for label, method in chosen.items()}
    methods |= {"learned": [Learned(network) for network in networks], "oracle": [Oracle()]}
    adjusted, given = {}, {}
    for part, problems in (unseen | control).items():
        poses = {label: [poses_of(seed, problems) for seed in seeds] for label, seeds in methods.items()}
        adjusted[part] = PartResult.of(problems, poses, problems.T_true)
        given[part] = PartResult.of(problems, poses | {"reference": [problems.T_true]}, problems.T_given)
    lines = [
        "Against the adjusted poses:\n",
        error_table({part: adjusted[part] for part in unseen}),
        "Against the poses that come with the sequences:\n",
        error_table({part: given[part] for part in unseen}),
        "In a rendered room with other textures and more noise than those trained on, poses exact:\n",
        error_table({part: adjusted[part] for part in control}),
        "Settings, each the best of its kind on the training part:\n",
        *(f"- {label}: {method}" for label, method in chosen.items()),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--steps", type=int, default=Settings.steps, help="training steps")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    training, networks = problems_of(TRAINING), []
    for seed in SEEDS:
        networks.append(MatchWeights(seed=seed))
        train(networks[-1], list(training.values()), replace(Settings(), steps=arguments.steps, seed=seed))
    text = evaluate(networks, training, problems_of(UNSEEN), problems_of({CONTROL: (0.0, 1.0)}))
    publish(text, arguments, __file__)


if __name__ == "__main__":
    main()
