"""Train an extractor by the errors of the poses it leads to, and compare it with the untrained one. See README.md.

python -m experiments.learned_weights.features.run --weights xfeat.safetensors
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from experiments.common import CONTROL, LEARNED_FEATURES, WEIGHTS_DIR, parser_of, part_of, publish, sequences
from experiments.learned_weights.features.evaluation import (
    APART_S,
    FRAMES,
    STEP_S,
    Pair,
    PairErrors,
    clip_from,
    pair_errors,
    position_error,
)
from experiments.learned_weights.features.front_end import Remembering, SubPixel
from experiments.learned_weights.features.report import Result, Results, medians, ratios
from experiments.learned_weights.features.tracks import Tracks
from experiments.learned_weights.features.training import Settings, train
from torchslam import ORB, ClipSLAM, XFeat
from torchslam.data.sequence import Sequence
from torchslam.learning.dataset import frames_in

WEIGHTS = WEIGHTS_DIR / LEARNED_FEATURES["xfeat"]
# Shares of the frames of a sequence.
TRAINING = ("machine_hall", (0.0, 0.6))
UNSEEN = {
    "machine_hall": (0.75, 1.0),
    "redkitchen": (0.0, 1.0),
    "fr2_desk_20": (0.0, 1.0),
    "shelf_bin": (0.0, 1.0),
    "kitti07": (0.0, 1.0),
}
KEYPOINTS = 600
BEFORE, AFTER = "XFeat", "XFeat, trained"


@dataclass(frozen=True)
class Part:
    """A part of a sequence to evaluate on, by the first frames of pairs and clips spread evenly over it."""

    sequence: Sequence
    pairs: list[int]
    clips: list[int]

    @classmethod
    def of(cls, sequence: Sequence, share: tuple[float, float], pairs: int, clips: int) -> Part:
        frames = part_of(sequence, share)
        last_pair = frames.stop - frames_in(APART_S, sequence) - 1
        last_clip = frames.stop - FRAMES * frames_in(STEP_S, sequence)
        return cls(sequence, spread(pairs, frames.start, last_pair), spread(clips, frames.start, last_clip))


def spread(count: int, first: int, last: int) -> list[int]:
    """At most `count` different numbers, evenly from the first to the last."""
    return torch.linspace(first, last, count).round().int().unique().tolist() if count else []


@torch.no_grad()
def measure(candidates: Mapping[str, nn.Module], parts: dict[str, Part], device: torch.device) -> Results:
    """The errors of every pair and clip."""
    results: Results = {label: {} for label in candidates}
    for name, part in parts.items():
        rows: dict[str, list[PairErrors]] = {label: [] for label in candidates}
        for start in part.pairs:
            pair = Pair.of(part.sequence, start, device)
            for label, extractor in candidates.items():
                rows[label].append(pair_errors(extractor(pair.images).to("cpu"), pair))
        clips = [clip_from(part.sequence, start, device) for start in part.clips]
        for label, extractor in candidates.items():
            found = [position_error(ClipSLAM(extractor), clip) for clip in clips]
            results[label][name] = Result(PairErrors.cat(rows[label]), torch.tensor(found))
        print(f"measured {name}", flush=True)
    return results


def parts_of(shares: dict[str, tuple[float, float]], pairs: int, clips: int) -> dict[str, Part]:
    """Parts of the available sequences."""
    return {
        name: Part.of(sequence, share, pairs, clips)
        for name, share in shares.items()
        for sequence in sequences([name])
    }


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument(
        "--weights", type=Path, default=WEIGHTS, help="XFeat's parameters, a safetensors file"
    )
    parser.add_argument("--steps", type=int, default=Settings.steps, help="training steps")
    parser.add_argument("--pairs", type=int, default=60, help="at most, of a part to evaluate on")
    parser.add_argument("--clips", type=int, default=10, help="at most, of a part to evaluate on")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    xfeat = Remembering(XFeat(arguments.weights, KEYPOINTS)).to(device)
    settings = Settings(steps=arguments.steps)
    trained = SubPixel(xfeat, settings.width, settings.reach).to(device)
    name, share = TRAINING
    for sequence in sequences([name]):
        train(trained, Tracks.of(xfeat, sequence, part_of(sequence, share), device), settings)
    candidates = {BEFORE: xfeat, AFTER: trained, "ORB": ORB(KEYPOINTS)}
    text = ""
    for title, parts in (("", UNSEEN), ("\nIn a rendered room, poses exact:\n\n", {CONTROL: (0.0, 1.0)})):
        results = measure(candidates, parts_of(parts, arguments.pairs, arguments.clips), device)
        text += title + medians(results) + "\n" + ratios(results[BEFORE], results[AFTER])
    publish(text, arguments, __file__)


if __name__ == "__main__":
    main()
