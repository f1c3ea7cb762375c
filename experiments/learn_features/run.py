"""Does a front end learn from the error of the poses that it leads to? See README.md."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import nn

from experiments.common import sequences, table, write_between
from experiments.learn_features.clips import FRAMES, STEP_S, clip_from, position_error
from experiments.learn_features.front_end import Remembering, SubPixel
from experiments.learn_features.pairs import APART_S, Pair, PairErrors, pair_errors
from experiments.learn_features.picture import draw
from experiments.learn_features.report import Result, Results, medians, ratio, ratios
from experiments.learn_features.room import room
from experiments.learn_features.tracks import Tracks, residuals
from experiments.learn_features.training import Settings, moved, train
from torchslam import ORB, ClipSLAM, XFeat
from torchslam.data.sequence import Sequence
from torchslam.learning.clips import frames_in

HERE = Path(__file__).parent
WEIGHTS = Path(__file__).parents[3] / "shared" / "weights" / "xfeat.safetensors"
# Shares of the frames of a sequence.
TRAINING = ("machine_hall", (0.0, 0.6))
VALIDATION = ("machine_hall", (0.6, 0.75))
UNSEEN = {
    "machine_hall": (0.75, 1.0),
    "redkitchen": (0.0, 1.0),
    "fr2_desk_20": (0.0, 1.0),
    "shelf_bin": (0.0, 1.0),
    "kitti07": (0.0, 1.0),
}
CONTROL = {"synthetic:room?frames=120&seed=2&noise=8&blur=0.8&exposure=0.3": (0.0, 1.0)}  # with exact poses
KEYPOINTS = 600
BLOCK_TRACKS = 200  # for intervals: tracks of neighbouring problems are mostly the same
BEFORE, AFTER = "XFeat", "XFeat, trained"
SMALL = Settings()
LARGE = Settings(steps=5000, problems=64, width=128)


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


def part_of(sequence: Sequence, share: tuple[float, float]) -> range:
    return range(*(round(end * len(sequence)) for end in share))


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
            for label, front_end in candidates.items():
                rows[label].append(pair_errors(front_end(pair.images).to("cpu"), pair))
        clips = [clip_from(part.sequence, start, device) for start in part.clips]
        for label, front_end in candidates.items():
            found = [position_error(ClipSLAM(front_end), clip) for clip in clips]
            results[label][name] = Result(PairErrors.cat(rows[label]), torch.tensor(found))
        print(f"measured {name}", flush=True)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="of XFeat, a safetensors file")
    parser.add_argument("--large", action="store_true", help="train longer: for a GPU")
    parser.add_argument("--steps", type=int, help="of training")
    parser.add_argument(
        "--seeds", type=int, default=1, help="trainings; those after the first on pairs alone"
    )
    parser.add_argument("--pairs", type=int, default=60, help="of a part to evaluate on, at most")
    parser.add_argument("--clips", type=int, default=10, help="likewise")
    parser.add_argument("--validate", action="store_true", help="evaluate on the validation part instead")
    parser.add_argument("--save", type=Path, help="file for the trained parameters, written")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = LARGE if arguments.large else SMALL
    settings = replace(settings, steps=arguments.steps) if arguments.steps else settings
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    xfeat = Remembering(XFeat(arguments.weights, KEYPOINTS)).to(device)

    learned_on = prepared(xfeat, device)
    if not learned_on:
        return  # `sequences` has said what is missing
    trained, losses = [], []
    for seed in range(arguments.seeds):
        trained.append(SubPixel(xfeat, settings.width, settings.reach, seed).to(device))
        losses.append(train(trained[-1], learned_on["training"], settings, seed))
    if arguments.save:
        torch.save(trained[0].network.state_dict(), arguments.save)

    unseen = parts_of(dict([VALIDATION]) if arguments.validate else UNSEEN, arguments.pairs, arguments.clips)
    candidates = {BEFORE: xfeat, AFTER: trained[0], "ORB": ORB(KEYPOINTS)}
    results = measure(candidates, unseen, device)
    text = medians(results) + "\n" + ratios(results[BEFORE], results[AFTER])
    print(text, flush=True)
    exact = measure(candidates, parts_of(CONTROL, arguments.pairs, arguments.clips), device)
    text += "\nIn a rendered room, poses exact:\n\n"
    text += medians(exact) + "\n" + ratios(exact[BEFORE], exact[AFTER])
    if arguments.seeds > 1:
        only_pairs = {name: replace(part, clips=[]) for name, part in unseen.items()}
        others = {f"{AFTER}, seed {seed}": one for seed, one in enumerate(trained) if seed}
        for label, found in measure(others, only_pairs, device).items():
            text += f"\n{label}:\n\n" + ratios(results[BEFORE], found)
    text += "\n" + keypoint_noise(trained[0], learned_on)
    text += "\n" + room_of(TRAINING, xfeat, arguments.pairs, device)
    print(text)
    if not arguments.validate:
        write_between(HERE / "README.md", text)
        draw(HERE / "learned.png", losses, results[BEFORE], results[AFTER])


def parts_of(shares: dict[str, tuple[float, float]], pairs: int, clips: int) -> dict[str, Part]:
    """Parts of the sequences that are at hand."""
    return {
        name: Part.of(sequence, share, pairs, clips)
        for name, share in shares.items()
        for sequence in sequences([name])
    }


def prepared(front_end: nn.Module, device: torch.device) -> dict[str, Tracks]:
    """The tracks of both parts of the sequence to learn from."""
    return {
        label: Tracks.of(front_end, sequence, part_of(sequence, share), device)
        for label, (name, share) in (("training", TRAINING), ("validation", VALIDATION))
        for sequence in sequences([name])
    }


def keypoint_noise(front_end: SubPixel, parts: dict[str, Tracks]) -> str:
    """A table of how far keypoints are from their points, true poses given, before and after."""
    rows = []
    for name, tracks in parts.items():
        before, after = (
            residuals(tracks, keypoints) for keypoints in (tracks.keypoints, moved(front_end, tracks))
        )
        medians_px = [f"{float(found.median()):.3f}" for found in (before, after)]
        rows.append([name, f"{len(before)}", *medians_px, ratio([(after / before).log()], BLOCK_TRACKS)])
    return table(["machine_hall", "tracks", "XFeat (px)", "trained (px)", "trained / not"], rows)


def room_of(part: tuple[str, tuple[float, float]], xfeat: nn.Module, count: int, device: torch.device) -> str:
    """The table of `room` for pairs spread over a part of a sequence."""
    name, share = part
    pairs = [
        Pair.of(sequence, start, device)
        for sequence in sequences([name])
        for start in Part.of(sequence, share, count, 0).pairs
    ]
    return room(xfeat, ORB(KEYPOINTS), pairs)


if __name__ == "__main__":
    main()
