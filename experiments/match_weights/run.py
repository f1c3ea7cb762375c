"""Does a network that weighs matches, trained through the solver, give better poses? See README.md."""

from __future__ import annotations

import argparse
import os
import re
from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist

from experiments.common import sequences, write_between
from experiments.match_weights.evaluation import Learned, Method, Oracle, candidates, choose, poses_of
from experiments.match_weights.picture import draw
from experiments.match_weights.problems import Problems, make_problems
from experiments.match_weights.reference import reference_poses
from experiments.match_weights.report import PartResult, error_table
from experiments.match_weights.training import Settings, train
from experiments.match_weights.weighting import MatchWeights

RENDERED = "synthetic:"
HERE = Path(__file__).parent
CACHE = HERE / "results"
# Sequences and the share of their frames that a part takes.
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
# Rendered with other textures, noise and exposure than those of the training: its poses are exact.
CONTROL = {"synthetic:room?frames=120&seed=2&noise=8&blur=0.8&exposure=0.3": (0.0, 1.0)}
VALIDATED = 0.4  # the share at the end of the training parts that `--validate` holds back
SEEDS = (0, 1, 2)
SMALL = Settings()
LARGE = Settings(steps=4000, batch=64, matches=400)


def problems_of(parts: dict[str, tuple[float, float]]) -> dict[str, Problems]:
    """The problems of parts of sequences, from the cache where they have been made before."""
    found = {}
    for name, (first, last) in parts.items():
        path = CACHE / f"{re.sub(r'[^a-z0-9_]', '_', name)}_{first:g}_{last:g}.pt"
        if not path.exists():
            for sequence in sequences([name]):
                part = range(round(first * len(sequence)), round(last * len(sequence)))
                make_problems(sequence, part, reference_poses(sequence, CACHE)).save(path)
        if path.exists():
            found[name] = Problems.load(path)
            print(f"{name} from {first:.0%} to {last:.0%}: {len(found[name])} problems", flush=True)
    return found


def split(parts: dict[str, Problems]) -> tuple[dict[str, Problems], dict[str, Problems]]:
    """The beginning of every part and the rest, without the problems that have frames in both."""
    earlier, later = {}, {}
    for name, problems in parts.items():
        cut = (1 - VALIDATED) * float(problems.spans.max())
        earlier[name] = problems[problems.spans[:, 1] < cut]
        later[name] = problems[problems.spans[:, 0] >= cut]
    return earlier, later


def evaluate(
    networks: list[MatchWeights],
    training: dict[str, Problems],
    unseen: dict[str, Problems],
    control: dict[str, Problems],
) -> tuple[str, dict[str, PartResult]]:
    """The tables and the results on the unseen parts; competitors choose their settings on the real training parts."""
    real = [part for name, part in training.items() if not name.startswith(RENDERED)]
    chosen = {label: choose(options, real) for label, options in candidates().items()}
    methods: dict[str, list[Method]] = {label: [method] for label, method in chosen.items()}
    methods |= {"learned": [Learned(network) for network in networks], "oracle": [Oracle()]}
    adjusted, given = {}, {}
    for part, problems in (unseen | control).items():
        poses = {label: [poses_of(seed, problems) for seed in seeds] for label, seeds in methods.items()}
        adjusted[part] = PartResult.of(problems, poses, problems.T_true)
        given[part] = PartResult.of(problems, poses | {"reference": [problems.T_true]}, problems.T_given)
    results = {part: adjusted[part] for part in unseen}
    lines = [
        "Against the adjusted poses:\n",
        error_table(results),
        "Against the poses that come with the sequences:\n",
        error_table({part: given[part] for part in unseen}),
        "In a rendered room with other textures and more noise than those trained on, poses exact:\n",
        error_table({part: adjusted[part] for part in control}),
        "Settings, each the best of its kind on the training part:\n",
        *(f"- {label}: {method}" for label, method in chosen.items()),
    ]
    return "\n".join(lines) + "\n", results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--large", action="store_true", help="train longer, on all matches: for a GPU")
    parser.add_argument("--steps", type=int, help="of training")
    parser.add_argument(
        "--validate",
        action="store_true",
        help="hold back the end of the training parts, leave the unseen alone",
    )
    parser.add_argument("--no-readme", action="store_true", help="print the tables, leave README and picture")
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
    held_back: dict[str, Problems] = {}
    if arguments.validate:
        rendered = {name: part for name, part in training.items() if name.startswith(RENDERED)}
        earlier, held_back = split({name: part for name, part in training.items() if name not in rendered})
        training = earlier | rendered
    networks = [trained(list(training.values()), replace(settings, seed=seed), first) for seed in SEEDS]
    if first:
        torch.save([network.state_dict() for network in networks], CACHE / "networks.pt")
        text, results = evaluate(networks, training, held_back or problems_of(UNSEEN), problems_of(CONTROL))
        print(text)
        if not (arguments.no_readme or arguments.validate):
            write_between(HERE / "README.md", text)
            draw(HERE / "errors.png", results)
    if distributed:
        dist.destroy_process_group()


def trained(parts: list[Problems], settings: Settings, talk: bool) -> MatchWeights:
    """A network trained on parts; with `talk`, its loss is printed."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = MatchWeights(seed=settings.seed).to(device)
    history = train(network, [part.to(device) for part in parts], settings)
    tenth = max(1, len(history) // 10)
    first, last = sum(history[:tenth]) / tenth, sum(history[-tenth:]) / tenth
    if talk:
        print(
            f"seed {settings.seed}: mean loss {first:.4f} in the first tenth, {last:.4f} in the last",
            flush=True,
        )
    return network.cpu()


if __name__ == "__main__":
    main()
