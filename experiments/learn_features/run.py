"""Does a front end learn from the error of the poses that it leads to? See README.md."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from torch import Tensor, nn

from experiments.common import sequences, table, write_between
from experiments.learn_features.clips import Clip, Errors, errors_of, step_of
from experiments.learn_features.front_end import SubPixel
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
BEFORE, AFTER = "XFeat", "XFeat, trained"
SMALL = Settings()
LARGE = Settings(steps=3000, clips=4, frames=10)


def clips_of(
    names: dict[str, tuple[float, float]], count: int, device: torch.device
) -> dict[str, list[Clip]]:
    """Clips spread evenly over parts of the sequences at hand."""
    found = {}
    for name, (first, last) in names.items():
        for sequence in sequences([name]):
            step = step_of(sequence)
            begin, end = round(first * len(sequence)), round(last * len(sequence)) - CLIP_FRAMES * step
            starts = torch.linspace(begin, max(begin, end), count).round().int().unique().tolist()
            found[name] = [Clip.of(sequence, start, CLIP_FRAMES, step, device) for start in starts]
    return found


@torch.no_grad()
def measure(front_end: nn.Module, unseen: dict[str, list[Clip]]) -> dict[str, list[Errors]]:
    """The errors of every clip, by sequence."""
    clip_slam = ClipSLAM(front_end)
    return {name: [errors_of(clip_slam, clip) for clip in clips] for name, clips in unseen.items()}


def report(results: dict[str, dict[str, list[Errors]]], unseen: dict[str, list[Clip]]) -> str:
    """A row per unseen sequence and front end: medians; then geometric means over the clips that all could pose."""
    rows = []
    for name, clips in unseen.items():
        for label, result in results.items():
            frames = sum(errors.posed for errors in result[name])
            inliers = sum(errors.seen for errors in result[name]) / max(1, frames)
            errors = numbers(errors for errors in result[name] if errors.enough)
            posed = f"{frames} of {len(clips) * CLIP_FRAMES}"
            rows.append([name, label, posed, f"{inliers:.0f}", *cells(errors.median(0).values)])
    common = common_clips(results)
    for label, errors in common.items():
        rows.append(["geometric mean", label, f"{len(errors)} clips", "", *cells(errors.log().mean(0).exp())])
    header = ["unseen", "front end", "frames posed", "inliers a frame", "ATE / path", "rotation error (mrad)"]
    return table(header, rows)


def common_clips(results: dict[str, dict[str, list[Errors]]]) -> dict[str, Tensor]:
    """(C, 2) errors by front end, of the clips in which all front ends have enough poses."""
    columns = [[errors for part in result.values() for errors in part] for result in results.values()]
    rows = [row for row in zip(*columns, strict=True) if all(errors.enough for errors in row)]
    return {label: numbers(row[index] for row in rows) for index, label in enumerate(results)}


def numbers(errors: Iterable[Errors]) -> Tensor:
    """(C, 2) position and rotation errors; a row of NaN where there are none."""
    rows = [torch.stack([one.position, one.rotation]) for one in errors]
    return torch.stack(rows) if rows else torch.full((1, 2), torch.nan)


def cells(errors: Tensor) -> list[str]:
    """Position and rotation error (2,) in words."""
    return [f"{100 * float(errors[0]):.2f} %", f"{1e3 * float(errors[1]):.2f}"]


def draw(path: Path, losses: list[float], results: dict[str, dict[str, list[Errors]]]) -> None:
    """Left the loss over the steps, right the rotation error of every unseen clip before and after."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.0), layout="constrained")
    left.plot(losses, ".", color="0.75", markersize=4, label="one clip")
    window = max(1, len(losses) // 8)
    means = torch.tensor(losses).unfold(0, window, 1).mean(-1)
    left.plot(range(window // 2, window // 2 + len(means)), means, color="#d62728", label=f"mean of {window}")
    left.set(xlabel="step", ylabel="log(ATE / path) + log(rotation error)", title="training")
    left.legend(frameon=False)
    for name in results[BEFORE]:
        pairs = zip(results[BEFORE][name], results[AFTER][name], strict=True)
        errors = [1e3 * torch.stack([a.rotation, b.rotation]) for a, b in pairs if a.enough and b.enough]
        if errors:
            right.plot(*torch.stack(errors).T, "o", markersize=5, label=name)
    right.axline((1, 1), (2, 2), color="0.7", linewidth=0.8, zorder=0)
    right.set(xscale="log", yscale="log", xlabel=f"{BEFORE} (mrad)", ylabel=f"{AFTER} (mrad)")
    right.set(title="rotation error of unseen clips; below the line: better", aspect="equal")
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
        unseen = clips_of(UNSEEN, CLIPS, device)
        candidates = {BEFORE: front_end.front_end, AFTER: front_end, "ORB": ORB(KEYPOINTS)}
        results = {label: measure(module, unseen) for label, module in candidates.items()}
        text = report(results, unseen)
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
