"""Settings compared with the default, in whole runs over real recordings: ratios of the ATE with intervals.

python -m experiments.recordings --arm "fewer keyframes" keyframes.max_translation=0.14 keyframes.min_overlap=0.7
python -m experiments.recordings shelf_bin --arm aliked features.kind=aliked 'features.weights="aliked.safetensors"'
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from experiments.common import (
    DATA_DIR,
    DRONE_CAMERA,
    DRONE_TRUTH,
    add_engine,
    available,
    metrics_of_runs,
    parser_of,
    row_of,
    table,
)
from torchslam.batch import Columns, Row

SEEDS = (0, 1, 2)
DEFAULT = "default"
ENOUGH = 0.9
"""Fraction of the frames posed by the default; with fewer, the path is another one and errors are not compared."""
_DRAWS = 2000


@dataclass(frozen=True)
class Recording:
    """A real sequence: file or folder in the data; camera, truth, limit as of a `Row`.

    group: recordings of the same images, which the bootstrap draws together
    """

    name: str
    group: str
    camera: str | None = None
    groundtruth: str | None = None
    limit: int | None = None

    def row(self, label: str, arm: str, seed: int, overrides: Sequence[str]) -> Row:
        truth = None if self.groundtruth is None else str(DATA_DIR / self.groundtruth)
        settings = (*overrides, f"seed={seed}")
        return row_of(
            self.name, label, arm, str(seed),
            overrides=settings, camera=self.camera, groundtruth=truth, limit=self.limit,
        )  # fmt: skip


RECORDINGS = {
    "redkitchen, 200 frames": Recording("redkitchen", "redkitchen", limit=200),
    "kitti07": Recording("kitti07", "kitti07"),
    "kitti07, 685 px": Recording("kitti07", "kitti07", camera="685.42,685.42,601.8873,183.1104"),
    "machine_hall, 160 frames": Recording("machine_hall", "machine_hall", limit=160),
    "shelf_bin": Recording("shelf_bin", "shelf_bin"),
    "fr2_desk_20": Recording("fr2_desk_20", "fr2_desk_20"),
    "drone, 160 frames": Recording(
        "drone.mp4", "drone", camera=DRONE_CAMERA, groundtruth=DRONE_TRUTH, limit=160
    ),
}
"""kitti07 with the camera that comes with it, which is 3 % wrong, and with COLMAP's; drone by COLMAP's poses, whose
units are arbitrary."""


def recordings(labels: Sequence[str]) -> dict[str, Recording]:
    """The labels (all if none are given) whose data are available."""
    chosen = {label: RECORDINGS[label] for label in labels or RECORDINGS}
    there = set(available(dict.fromkeys(one.name for one in chosen.values())))
    return {label: one for label, one in chosen.items() if one.name in there}


@dataclass(frozen=True)
class Outcome:
    """The result of a run: fraction of posed frames, and ATE, None without a map."""

    posed: float
    ate: float | None

    @classmethod
    def of(cls, figures: Columns) -> Outcome:
        return cls(figures["posed"] / figures["frames"], figures.get("ate_m"))


Outcomes = dict[tuple[str, str, int], Outcome]
"""By recording, arm and seed."""


def outcomes_of(options: argparse.Namespace, arms: Mapping[str, Sequence[str]]) -> Outcomes:
    """Run the recordings and seeds that the options select with the settings of each arm, or reuse the results.

    Raises SystemExit for an error.
    """
    cases = [
        (label, arm, seed) for seed in options.seeds for arm in arms for label in recordings(options.labels)
    ]
    rows = [RECORDINGS[label].row(label, arm, seed, arms[arm]) for label, arm, seed in cases]
    figures = metrics_of_runs(rows, options)
    return {case: Outcome.of(found) for case, found in zip(cases, figures, strict=True)}


def log_ratios(outcomes: Outcomes, label: str, arm: str, reference: str = DEFAULT) -> dict[int, float]:
    """By seed, the logarithm of an arm's ATE over that of another; without seeds in which too little is posed."""
    found = {}
    for seed in SEEDS:
        one, other = outcomes.get((label, arm, seed)), outcomes.get((label, reference, seed))
        if one is None or other is None or one.ate is None or other.ate is None:
            continue
        if one.posed >= ENOUGH * other.posed:
            found[seed] = math.log(one.ate / other.ate)
    return found


def geometric_mean(ratios: dict[str, dict[int, float]]) -> float:
    """The mean ratio of recordings, each being the mean of its seeds; NaN where there are none."""
    means = [sum(by_seed.values()) / len(by_seed) for by_seed in ratios.values() if by_seed]
    return math.exp(sum(means) / len(means)) if means else math.nan


def interval(
    ratios: dict[str, dict[int, float]], group: dict[str, str], seed: int = 0
) -> tuple[float, float]:
    """95 % interval of `geometric_mean` by a bootstrap over images, with the recordings that share them, and seeds.

    ratios: by recording; group: of each recording
    """
    groups: dict[str, list[list[float]]] = {}
    for label, by_seed in ratios.items():
        if by_seed:
            groups.setdefault(group[label], []).append(list(by_seed.values()))
    if len(groups) < 2:
        return math.nan, math.nan
    generator = torch.Generator().manual_seed(seed)

    def drawn(count: int) -> list[int]:
        return torch.randint(count, (count,), generator=generator).tolist()

    families, means = list(groups.values()), []
    for _ in range(_DRAWS):
        some = [values for number in drawn(len(families)) for values in families[number]]
        each = [sum(values[k] for k in drawn(len(values))) / len(values) for values in some]
        means.append(math.exp(sum(each) / len(each)))
    low, high = torch.tensor(means).quantile(torch.tensor([0.025, 0.975])).tolist()
    return low, high


HEADER = ["recording", "arm", "posed, %", "ATE"]


def report(outcomes: Outcomes, arms: Sequence[str], reference: str = DEFAULT) -> str:
    """A row for every recording and arm, seed by seed, `-` for one not run, and the geometric means."""
    labels = list(dict.fromkeys(label for label, _, _ in outcomes))
    made = dict.fromkeys((label, arm) for label, arm, _ in outcomes)
    rows = [_row(outcomes, label, arm, reference) for label in labels for arm in arms if (label, arm) in made]
    group = {label: RECORDINGS[label].group for label in labels}
    for arm in arms:
        ratios = {label: log_ratios(outcomes, label, arm, reference) for label in labels}
        counted = sum(bool(by_seed) for by_seed in ratios.values())
        low, high = interval(ratios, group)
        mean = f"**{geometric_mean(ratios):.2f}**"
        if not math.isnan(low):  # of one recording there is none
            mean += f" ({low:.2f} to {high:.2f})"
        if arm != reference and counted:
            rows.append([f"geometric mean of {counted}", arm, "", "", mean])
    return table([*HEADER, f"over {reference}"], rows)


def _row(outcomes: Outcomes, label: str, arm: str, reference: str) -> list[str]:
    runs = [outcomes.get((label, arm, seed)) for seed in SEEDS]
    posed = " ".join("-" if run is None else f"{100 * run.posed:.0f}" for run in runs)
    ates = " ".join("-" if run is None else _ate(run) for run in runs)
    ratios = log_ratios(outcomes, label, arm, reference)
    ratio = "" if arm == reference else f"{geometric_mean({label: ratios}):.2f}" if ratios else "not compared"
    return [label, arm, posed, ates, ratio]


def _ate(run: Outcome) -> str:
    return "none" if run.ate is None else f"{run.ate:.4f}"


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("labels", nargs="*", choices=[[], *RECORDINGS], help="recordings; all by default")
    parser.add_argument(
        "--arm", nargs="+", action="append", default=[], metavar=("NAME", "section.key=value"),
        help="name and settings of what is compared with the default; repeatable",
    )  # fmt: skip
    parser.add_argument("--seeds", nargs="*", type=int, default=list(SEEDS), choices=SEEDS)
    add_engine(parser, "recordings")
    options = parser.parse_args()
    arms = {DEFAULT: []} | {name: settings for name, *settings in options.arm}
    print(report(outcomes_of(options, arms), list(arms)))


if __name__ == "__main__":
    main()
