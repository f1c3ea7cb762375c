"""What could a better aggregation gain at most, and where are the wrong depths? From the truth of a run.

python -m experiments.dense.limits RESULTS [--depth FOLDER]

Two perfect networks beside the classical aggregation: one that knows which depth of a view alone is right, and one
that chooses the right minimum among the lowest ones of the aggregated cost at half size. `torchslam densify` must have
been run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from experiments.dense.compare import RIGHT, errors, kept_with, least_for, most_at
from experiments.dense.peers import Depth, fused
from experiments.dense.run import opened, truth_of
from torchslam.dense import DepthMaps
from torchslam.dense.confidence import LEAST_KEPT, confidence_alone
from torchslam.dense.consistency import render
from torchslam.dense.cost_volume import inverse_depth_planes, semi_global
from torchslam.dense.estimate import PLANES, estimate_depth
from torchslam.densify.views import SWEPT, Views
from torchslam.geometry import se3_inverse
from torchslam.io.results import DEPTHS

MINIMA = 4  # that a network could choose among
SURE = 0.99  # what the perfect confidence says
BORDER_PX, BORDER_JUMP = 6, 1.15  # a pixel is at a border if depth varies by such a factor so near it
LITTLE_TEXTURE = 4 / 255  # standard deviation of gray in windows of seven pixels
LEAST_OTHERS = 3  # other frames of the sensor that must see a pixel, to say whether they contradict


def lowest_minima(cost: Float[Tensor, "D H W"], count: int = MINIMA) -> Float[Tensor, "N H W"]:
    """Positions of the lowest local minima of each pixel, in steps, lowest first; NaN where there are fewer."""
    padded = F.pad(cost[None], (0, 0, 0, 0, 1, 1), value=torch.inf)[0]
    below, above = padded[:-2], padded[2:]
    is_minimum = (cost < below) & (cost <= above)
    least, place = cost.masked_fill(~is_minimum, torch.inf).topk(count, dim=0, largest=False)
    a, b = below.gather(0, place), above.gather(0, place)
    curvature = a - 2 * least + b
    offset = torch.where(torch.isfinite(curvature), 0.5 * (a - b) / curvature, 0.0)
    return torch.where(torch.isfinite(least), place + offset, torch.nan)


def at_borders(depth: Float[Tensor, "K H W"]) -> Bool[Tensor, "K H W"]:
    """Whether known depth jumps near a pixel."""
    known, window = depth > 0, (2 * BORDER_PX + 1, 1, BORDER_PX)
    largest = F.max_pool2d(depth, *window)
    least = -F.max_pool2d(-depth.masked_fill(~known, torch.inf), *window)
    return known & (largest > BORDER_JUMP * least)


def depth_of_others(views: Views, truth: Float[Tensor, "K H W"]) -> Float[Tensor, "K H W"]:
    """Median inverse depth of the other frames' truth, 0 where too few of them see a pixel."""
    inverse, found = torch.where(truth > 0, 1 / truth, 0.0), []
    for view in range(len(views)):
        rendered = render(
            inverse[list(views.neighbors[view])], views.camera, se3_inverse(views.T_sr(view)).float()
        )
        is_seen = rendered > 0
        median = rendered.masked_fill(~is_seen, torch.nan).nanmedian(0).values
        found.append(torch.where(is_seen.sum(0) >= LEAST_OTHERS, median, 0.0))
    return torch.stack(found)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--depth", type=Path, help="folder of the sensor's depth; else the scene is rendered")
    options = parser.parse_args()
    maps = DepthMaps.load(options.results / DEPTHS)
    with torch.enable_grad():  # the sensor's pose is found by gradients
        truth = truth_of(options.results, maps, options.depth)
    views, images = opened(options.results, maps)
    depths, confidences, has_right, textures = [], [], [], []
    for view in range(len(views)):
        volumes: list[Tensor] = []

        def aggregate(cost: Tensor, image: Tensor, volumes: list[Tensor] = volumes) -> Tensor:
            volumes.append(semi_global(cost, image))
            return volumes[-1]

        sources = torch.stack([images.gray(other) for other in views.neighbors[view][:SWEPT]])
        limits, gray = (views.near[view, None], views.far[view, None]), images.gray(view)[None]
        poses = views.T_sr(view)[None, :SWEPT]
        found = estimate_depth(gray, sources[None], views.camera, poses, *limits, aggregate)
        planes = inverse_depth_planes(*limits, PLANES)[0]
        minima = (planes[0] + (planes[1] - planes[0]) * lowest_minima(volumes[0][0])).float()
        minima = F.interpolate(minima[None], scale_factor=2)[0]
        depths.append(torch.cat((found.inverse_depth, minima)))
        has_right.append((truth[view] > 0) & ((1 / (depths[-1] * truth[view]) - 1).abs() < RIGHT))
        confidences.append(confidence_alone(found)[0])
        mean = F.avg_pool2d(gray, 7, 1, 3)
        textures.append((F.avg_pool2d(gray * gray, 7, 1, 3) - mean * mean)[0].clamp(min=0).sqrt())
    is_right, known, alone = torch.stack(has_right), truth > 0, torch.stack([each[0] for each in depths])

    def of(depth: Tensor, confidence: Tensor) -> Depth:
        both: Callable[[int], tuple[Tensor, Tensor]] = lambda view: (depth[view], confidence[view])  # noqa: E731
        return fused(views, list(range(len(views))), both)

    classical = torch.stack(confidences)
    base = of(alone, classical)
    is_kept = kept_with(base, truth, LEAST_KEPT)
    share, wrong = float(is_kept.sum() / known.sum()), errors(base, truth, is_kept)
    accuracy = float((wrong < RIGHT).double().mean())
    others = depth_of_others(views, truth)
    little = torch.stack(textures) < LITTLE_TEXTURE
    print(f"kept {share:.1%}, of those wrong by more than 5 %: {1 - accuracy:.1%}")
    for name, depth, counted in (
        ("wrong, of a view alone", alone, known),
        ("wrong, of what is kept", base.inverse_depth, is_kept),
    ):
        error = (1 / (depth * truth) - 1).abs()
        some = counted & (error >= RIGHT)
        judged = some & (others > 0)
        parts = {
            f"lowest of {MINIMA} minima right": is_right[:, 1],
            f"another of {MINIMA} right": is_right[:, 2:].any(1) & ~is_right[:, 1],
            "error below 10 %": error < 2 * RIGHT,
            "at borders": at_borders(truth),
            "little texture, not at borders": little & ~at_borders(truth),
        }
        said = [f"{part}: {float((some & each).sum() / some.sum()):.1%}" for part, each in parts.items()]
        contradicted = judged & ((others * truth - 1).abs() > RIGHT)
        ours = judged & ((others / depth - 1).abs() < RIGHT)
        said.append(f"truth of other frames contradicts it: {float(contradicted.sum() / judged.sum()):.1%}")
        said.append(f"it agrees with ours: {float(ours.sum() / judged.sum()):.1%}")
        print(f"{name} ({float(some.sum() / known.sum()):.1%} of all): {'; '.join(said)}")
    best = torch.where(is_right[:, 0], 0, is_right.float().argmax(1))  # the found one where none is right
    chosen = torch.stack(depths).gather(1, best[:, None])[:, 0]
    sure = lambda right: torch.where(known, torch.where(right, SURE, 1 - SURE), classical)  # noqa: E731
    print("\n| | wrong by more than 5 % at the same share | kept at the same accuracy |\n|---|---|---|")
    for name, either in (
        ("classical", base),
        ("true confidence", of(alone, sure(is_right[:, 0]))),
        (f"true choice of {MINIMA} minima", of(chosen, classical)),
        ("both", of(chosen, sure(is_right.any(1)))),
    ):
        same = errors(either, truth, kept_with(either, truth, least_for(either, truth, share)))
        ratio = float((same > RIGHT).double().mean()) / (1 - accuracy)
        print(f"| {name} | {ratio:.2f} | {most_at(either, truth, accuracy):.1%} |", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
