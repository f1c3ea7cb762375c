"""Does a front end learn from the error of the poses that it leads to? See README.md."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from torch import Tensor, nn

from experiments.common import sequences, table, write_between
from experiments.learn_features.clips import Clip, Errors, errors_of, step_of
from experiments.learn_features.front_end import SubPixel
from experiments.learn_features.pairs import PairErrors, frames_apart, pair_errors
from experiments.learn_features.training import Settings, train
from torchslam import ORB, ClipSLAM, XFeat
from torchslam.data.sequence import Sequence

HERE = Path(__file__).parent
WEIGHTS = Path(__file__).parents[3] / "shared" / "weights" / "xfeat.safetensors"
TRAINING = ("machine_hall", 0.6)  # and the share of its frames, from the first on
UNSEEN = {
    "machine_hall": (0.65, 1.0),
    "redkitchen": (0.0, 1.0),
    "fr2_desk_20": (0.0, 1.0),
    "shelf_bin": (0.0, 1.0),
    "kitti07": (0.0, 1.0),
}
KEYPOINTS = 600
CLIP_FRAMES = 8  # of a clip to evaluate
CLIPS = 4  # per unseen sequence, evenly over it
PAIRS = 25  # likewise
BEFORE, AFTER = "XFeat", "XFeat, trained"
SMALL = Settings()
LARGE = Settings(steps=3000, clips=4, frames=10)


@dataclass(frozen=True)
class Part:
    """A part of a sequence to evaluate on: first frames of pairs, and clips."""

    sequence: Sequence
    pairs: list[int]
    clips: list[Clip]


def parts_of(names: dict[str, tuple[float, float]], device: torch.device) -> dict[str, Part]:
    """Pairs and clips spread evenly over parts of the sequences at hand."""
    found = {}
    for name, (first, last) in names.items():
        for sequence in sequences([name]):
            step = step_of(sequence)
            begin, end = round(first * len(sequence)), round(last * len(sequence))
            pairs = spread(PAIRS, begin, end - frames_apart(sequence) - 1)
            clips = spread(CLIPS, begin, end - CLIP_FRAMES * step)
            made = [Clip.of(sequence, start, CLIP_FRAMES, step, device) for start in clips]
            found[name] = Part(sequence, pairs, made)
    return found


def spread(count: int, first: int, last: int) -> list[int]:
    """At most `count` different numbers, evenly from the first to the last."""
    return torch.linspace(first, last, count).round().int().unique().tolist()


@dataclass(frozen=True)
class Result:
    """What a front end is worth on one part of a sequence."""

    pairs: PairErrors
    clips: list[Errors]


@torch.no_grad()
def measure(front_end: nn.Module, parts: dict[str, Part], device: torch.device) -> dict[str, Result]:
    """The errors of every pair and clip, by sequence."""
    clip_slam = ClipSLAM(front_end)
    return {
        name: Result(
            pair_errors(front_end, part.sequence, part.pairs, device),
            [errors_of(clip_slam, clip) for clip in part.clips],
        )
        for name, part in parts.items()
    }


def report(results: dict[str, dict[str, Result]]) -> str:
    """Medians by unseen part and front end; then geometric means over the pairs and clips that all could pose."""
    rows = []
    for name in results[BEFORE]:
        for label, parts in results.items():
            pairs, clips = parts[name].pairs, parts[name].clips
            median = torch.stack([pairs.rotation, pairs.direction]).nanmedian(-1).values
            ates = torch.stack(
                [clip.position if clip.enough else clip.position * torch.nan for clip in clips]
            )
            rows.append(
                [
                    name,
                    label,
                    f"{float(pairs.inliers.mean()):.0f}",
                    *_angles(median),
                    f"{sum(clip.enough for clip in clips)} of {len(clips)}",
                    _share(ates.nanmedian()),
                ]
            )
    pairs_by_label, clips_by_label = common_pairs(results), common_clips(results)
    for label in results:
        pairs, clips = pairs_by_label[label], clips_by_label[label]
        means = [errors.log().mean(-1).exp() for errors in (pairs, clips)]
        rows.append(
            [
                "geometric mean",
                label,
                f"{pairs.shape[-1]} pairs",
                *_angles(means[0]),
                f"{len(clips)} clips",
                _share(means[1]),
            ]
        )
    header = ["unseen", "front end", "inliers a pair", "rotation error (mrad)", "direction error (°)"]
    return table([*header, "clips posed", "ATE / path"], rows)


def common_pairs(results: dict[str, dict[str, Result]]) -> dict[str, Tensor]:
    """(2, P) rotation and direction errors by front end, of the pairs for which all front ends have a motion."""
    errors = torch.stack(
        [
            torch.cat(
                [torch.stack([part.pairs.rotation, part.pairs.direction]) for part in parts.values()], 1
            )
            for parts in results.values()
        ]
    )
    return dict(zip(results, errors[..., ~errors.isnan().any(0).any(0)], strict=True))


def common_clips(results: dict[str, dict[str, Result]]) -> dict[str, Tensor]:
    """(C,) position errors by front end, of the clips in which all front ends have enough poses."""
    columns = [[clip for part in parts.values() for clip in part.clips] for parts in results.values()]
    rows = [row for row in zip(*columns, strict=True) if all(clip.enough for clip in row)]
    positions = torch.tensor([[float(clip.position) for clip in row] for row in rows]).view(-1, len(results))
    return dict(zip(results, positions.T, strict=True))


def _angles(errors: Tensor) -> list[str]:
    return [f"{1e3 * float(errors[0]):.2f}", f"{math.degrees(float(errors[1])):.2f}"]


def _share(error: Tensor) -> str:
    return f"{100 * float(error):.2f} %"


def draw(path: Path, losses: list[float], results: dict[str, dict[str, Result]]) -> None:
    """Left the loss over the steps, right the rotation error of every unseen pair before and after."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.0), layout="constrained")
    left.plot(losses, ".", color="0.75", markersize=4, label="one clip")
    window = max(1, len(losses) // 8)
    means = torch.tensor(losses).unfold(0, window, 1).mean(-1)
    left.plot(range(window // 2, window // 2 + len(means)), means, color="#d62728", label=f"mean of {window}")
    left.set(xlabel="step", ylabel="log(ATE / path) + log(rotation error)", title="training")
    left.legend(frameon=False)
    for name, part in results[BEFORE].items():
        before, after = part.pairs.rotation, results[AFTER][name].pairs.rotation
        right.plot(1e3 * before, 1e3 * after, "o", markersize=4, label=name)
    right.axline((1, 1), (2, 2), color="0.7", linewidth=0.8, zorder=0)
    right.set(xscale="log", yscale="log", xlabel=f"rotation error, {BEFORE} (mrad)", ylabel=f"{AFTER} (mrad)")
    right.set(title="unseen pairs; below the line: better", aspect="equal")
    right.legend(frameon=False, fontsize=8)
    for axis in (left, right):
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="of XFeat, a safetensors file")
    parser.add_argument("--large", action="store_true", help="train longer, on more clips: for a GPU")
    parser.add_argument("--steps", type=int, help="of training")
    parser.add_argument("--save", type=Path, help="file for the trained parameters, written")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    settings = LARGE if arguments.large else SMALL
    settings = replace(settings, steps=arguments.steps) if arguments.steps else settings
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    front_end = SubPixel(XFeat(arguments.weights, KEYPOINTS)).to(device)
    name, share = TRAINING
    for sequence in sequences([name]):
        losses = train(ClipSLAM(front_end), drawing(sequence, share, settings.frames, device), settings)
        if arguments.save:
            torch.save(front_end.moves.state_dict(), arguments.save)
        unseen = parts_of(UNSEEN, device)
        candidates = {BEFORE: front_end.front_end, AFTER: front_end, "ORB": ORB(KEYPOINTS)}
        results = {label: measure(module, unseen, device) for label, module in candidates.items()}
        text = report(results)
        print(text)
        write_between(HERE / "README.md", text)
        draw(HERE / "learned.png", losses, results)


def drawing(sequence: Sequence, share: float, frames: int, device: torch.device) -> Callable[..., Clip]:
    """A function that draws clips from the first share of a sequence, at two speeds."""
    usual = step_of(sequence)

    def draw_clip(generator: torch.Generator) -> Clip:
        step = int(torch.randint(max(1, usual - 1), usual + 1, (1,), generator=generator))
        last = round(share * len(sequence)) - frames * step
        start = int(torch.randint(0, last + 1, (1,), generator=generator))
        return Clip.of(sequence, start, frames, step, device)

    return draw_clip


if __name__ == "__main__":
    main()
