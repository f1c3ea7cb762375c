"""Learned beside classical aggregation: errors at the same kept share, and what is kept at the same accuracy.

python -m experiments.dense.compare RESULTS [--depth FOLDER] [--weights FILE]

Views, images, poses and the comparison of the views are the same. `torchslam densify` must have been run. The share is
the one that the classical aggregation keeps; the learned one keeps as much by another least confidence.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor

from experiments.common import parser_of, timed
from experiments.dense.run import LEVELS, add_truth, estimator, opened, truth_of
from torchslam.dense import DepthMaps
from torchslam.dense.consistency import LEAST_KEPT, confidence_alone, confidence_together, kept, merge
from torchslam.dense.estimate import Estimate
from torchslam.dense.learned import RatingNet, learned_confidence
from torchslam.densify.views import Views
from torchslam.io.results import DEPTHS

HALVINGS = 18  # of the interval in which a least confidence is sought
CANDIDATES = torch.linspace(0.02, 0.998, 100)  # least confidences
RIGHT = 0.05


Alone = Callable[[int], tuple[Tensor, Tensor]]
"""Inverse depth and confidence (H, W) of a view alone."""


class Depth(NamedTuple):
    """Inverse depth of views, 0 where unknown, and its confidence."""

    inverse_depth: Float[Tensor, "K H W"]
    confidence: Float[Tensor, "K H W"]


def fused(views: Views, alone: Alone) -> Depth:
    """Depth of all views after the comparison with their neighbors."""
    depths, confidences = [], []
    for view in range(len(views)):
        others = [alone(other) for other in views.neighbors[view]]
        depth, confidence = alone(view)
        near, weights = (torch.stack([each[i] for each in others]) for i in (0, 1))
        merged = merge(depth, confidence, near, weights, views.camera, views.T_sr(view))
        depths.append(merged.inverse_depth)
        confidences.append(confidence_together(merged, confidence))
    return Depth(torch.stack(depths), torch.stack(confidences))


def kept_with(depth: Depth, truth: Tensor, least: float) -> Tensor:
    """Pixels with truth that are kept with a least confidence."""
    return torch.stack([kept(each, least) for each in depth.confidence]) & (truth > 0)


def errors(depth: Depth, truth: Tensor, is_kept: Tensor) -> Tensor:
    """Relative errors of kept depth."""
    return (1 / (depth.inverse_depth[is_kept] * truth[is_kept]) - 1).abs()


def least_for(depth: Depth, truth: Tensor, share: float) -> float:
    """The least confidence with which so much is kept."""
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        is_more = float(kept_with(depth, truth, middle).sum() / (truth > 0).sum()) > share
        low, high = (middle, high) if is_more else (low, middle)
    return low


def most_at(depth: Depth, truth: Tensor, accuracy: float) -> float:
    """The largest share of the pixels with truth that is kept with so many of them within 5 %."""
    most = 0.0
    for least in CANDIDATES.tolist():
        is_kept = kept_with(depth, truth, least)
        if bool(is_kept.any()) and float((errors(depth, truth, is_kept) < RIGHT).double().mean()) >= accuracy:
            most = max(most, float(is_kept.sum() / (truth > 0).sum()))
    return most


def main() -> None:
    parser = parser_of(__doc__)
    add_truth(parser)
    parser.add_argument(
        "--weights", type=Path, nargs="*", default=[], help="of other networks, to be measured too"
    )
    options = parser.parse_args()
    maps = DepthMaps.load(options.results / DEPTHS)
    truth, (views, images) = truth_of(options.results, maps, options.depth), opened(options.results, maps)
    seconds: list[float] = []
    swept = estimator(views, images)

    @cache
    def estimate(view: int) -> Estimate:
        for each in (view, *views.neighbors[view]):
            images.gray(each)  # reading is not counted
        found, spent = timed(lambda: swept(view))
        seconds.append(spent / 1e3)
        return found

    def classical(view: int) -> tuple[Tensor, Tensor]:
        found = estimate(view)
        return found.inverse_depth[0], confidence_alone(found)[0]

    def learned(net: RatingNet | None) -> Alone:
        @cache
        @torch.no_grad()
        def alone(view: int) -> tuple[Tensor, Tensor]:
            found, gray = estimate(view), images.gray(view)[None]
            limits = views.near[view, None], views.far[view, None]
            confidence, spent = timed(lambda: learned_confidence(found, gray, *limits, net))
            added.append(spent / 1e3)
            return found.inverse_depth[0], confidence[0]

        return alone

    base = fused(views, classical)
    is_kept = kept_with(base, truth, LEAST_KEPT)
    share, wrong = float(is_kept.sum() / (truth > 0).sum()), errors(base, truth, is_kept)
    accuracy = float((wrong < RIGHT).double().mean())
    print("| | kept | wrong by more than 1 % | 2 % | 5 % | 10 % | kept at the same accuracy | CPU s |")
    print("|---|---|---|---|---|---|---|---|")

    def row(name: str, depth: Depth, wrong: Tensor, taken: float) -> None:
        shares = [float((wrong > level).double().mean()) for level in LEVELS]
        cells = [float(len(wrong) / (truth > 0).sum()), *shares, most_at(depth, truth, accuracy)]
        print(f"| {name} | {' | '.join(f'{each:.1%}' for each in cells)} | {taken:.3f} |", flush=True)

    row("classical", base, wrong, sum(seconds) / len(seconds))
    for weights in options.weights or [None]:
        net, added = None, list[float]()
        if weights is not None:
            net = RatingNet().requires_grad_(False)
            net.load_state_dict(load_file(weights))
        depth = fused(views, learned(net))
        taken = (sum(seconds) + sum(added)) / len(seconds)
        name = "learned" if weights is None else weights.stem
        same = kept_with(depth, truth, least_for(depth, truth, share))
        row(f"{name}, as much kept", depth, errors(depth, truth, same), taken)
        row(f"{name}", depth, errors(depth, truth, kept_with(depth, truth, LEAST_KEPT)), taken)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
