"""Do whole runs gain by weights of matches that were learned on other recordings? See README.md, "Inside tracking".

python -m experiments.match_weights.whole_runs
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from experiments.common import write_between
from experiments.match_weights.hook import HookWeights, as_in_tracking, refine_shown, save
from experiments.match_weights.run import CACHE, HERE, TRAINING, problems_of
from experiments.match_weights.training import Settings, losses, train
from experiments.recordings import DEFAULT, KEPT_ORB, RECORDINGS, add_choices, outcomes_of, report
from torchslam.batch.fingerprints import digest

ALIKE, LEARNED = "alike", "learned"
ARMS = (DEFAULT, ALIKE, LEARNED)
HOOK = "experiments.match_weights.hook"
PARTS = (
    "redkitchen",
    "kitti07",
    "machine_hall",
    "synthetic:room",
)  # of `TRAINING`, each its first half, the room whole
SETTINGS = Settings(steps=150, batch=16)


def network_file(left_out: str, seed: int) -> Path:
    """Of a network that has seen nothing of a recording."""
    parts, settings = parts_without(left_out), replace(SETTINGS, seed=seed)
    code = [(HERE / file).read_text(encoding="utf-8") for file in ("hook.py", "layers.py")]
    name = digest({"parts": parts, "settings": repr(settings), "code": code})
    return CACHE / "hook" / f"{name}.pt"


def parts_without(left_out: str) -> list[str]:
    return sorted(name for name in PARTS if name != left_out)


def trained(left_out: str, seed: int) -> Path:
    """`network_file`, made unless it is there."""
    path = network_file(left_out, seed)
    if not path.exists():
        found = problems_of({name: TRAINING[name] for name in parts_without(left_out)})
        network = HookWeights(seed=seed)
        problems = [as_in_tracking(part) for part in found.values()]
        history = train(network, problems, replace(SETTINGS, seed=seed), refine_shown)
        tenth = len(history) // 10
        first, last = sum(history[:tenth]) / tenth, sum(history[-tenth:]) / tenth
        print(f"without {left_out}, seed {seed}: mean loss {first:.4f}, in the end {last:.4f}", flush=True)
        save(network, path)
    return path


def overrides(label: str, arm: str, seed: int) -> tuple[str, ...]:
    """The settings of a run: the seed of the network is that of the run."""
    if arm == DEFAULT:
        return KEPT_ORB
    if arm == ALIKE:
        return (*KEPT_ORB, f"matching.matcher={HOOK}:Alike")
    path = trained(RECORDINGS[label].kin, seed).absolute()
    return (*KEPT_ORB, f"matching.matcher={HOOK}:Learned", f'matching.weights="{path}"')


def held_out(seed: int) -> None:
    """What a network gains on the problems of a recording that it has not seen: printed, part by part."""
    for name in PARTS[:3]:
        problems = as_in_tracking(problems_of({name: TRAINING[name]})[name])
        units = torch.ones(len(problems), 2, dtype=torch.float64) * torch.tensor([0.01, 0.001])
        learned, alike = HookWeights(), HookWeights()
        learned.load_state_dict(torch.load(trained(name, seed), weights_only=True))
        found = [losses(one, problems, units, refine_shown).mean() for one in (alike, learned)]
        print(
            f"{name}, unseen, seed {seed}: loss {found[0]:.4f} with equal weights, {found[1]:.4f} with learned ones"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_choices(parser, ARMS)
    parser.add_argument("--held-out", action="store_true", help="problems alone, no runs")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.held_out:
        for seed in arguments.seeds:
            held_out(seed)
        return
    outcomes = outcomes_of(arguments, overrides)
    text = report(outcomes, arguments.arms)
    if LEARNED in arguments.arms and ALIKE in arguments.arms:
        text += "\nWeights that were learned beside equal ones:\n\n" + report(
            outcomes, [LEARNED], beside=ALIKE
        )
    print(text)
    if not arguments.no_readme:
        write_between(HERE / "whole_runs.md", text)


if __name__ == "__main__":
    main()
