"""Fit the constants of `torchslam.dense.consistency` to depth that is known, recordings weighted equally.

python -m experiments.dense.fit RESULTS[=FOLDER] ...    with the folder of the sensor's depth; without, it is rendered

Depth maps of the results are needed: run `torchslam densify` first. Half of each recording's pixels are fitted.
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from experiments.dense.run import estimator, opened, truth_of
from torchslam.dense import DepthMaps
from torchslam.dense.consistency import alone_features, confidence_alone, merge, together_features
from torchslam.io.results import DEPTHS

RIGHT = 0.05
SAMPLE = 9  # every so many pixels
ITERATIONS = 30


def samples(folder: Path, depth: Path | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features of depth alone and whether it is right, and the same for depth merged with that of neighbors."""
    maps = DepthMaps.load(folder / DEPTHS)
    truth, (views, images) = truth_of(folder, maps, depth), opened(folder, maps)

    estimate = estimator(views, images)

    @cache
    def alone(view: int) -> tuple[Tensor, Tensor, Tensor]:
        found = estimate(view)
        return found.inverse_depth[0], confidence_alone(found)[0], alone_features(found)[0]

    rows: list[list[Tensor]] = [[], [], [], []]
    for view in range(len(views)):
        others = [alone(other) for other in views.neighbors[view]]
        inverse_depth, confidence, features = alone(view)
        depths, confidences = (torch.stack([each[i] for each in others]) for i in (0, 1))
        merged = merge(inverse_depth, confidence, depths, confidences, views.camera, views.T_sr(view))
        place = torch.nonzero(truth[view].flatten() > 0)[::SAMPLE, 0]
        for which, (q, each) in enumerate(
            ((inverse_depth, features), (merged.inverse_depth, together_features(merged, confidence)))
        ):
            wrong = (1 / (q * truth[view])).flatten()[place] - 1
            rows[2 * which].append(each.flatten(0, 1)[place])
            rows[2 * which + 1].append((wrong.abs() < RIGHT).double())
    a, b, c, d = (torch.cat(each) for each in rows)
    return a, b, c, d


def fit(features: list[Tensor], right: list[Tensor]) -> list[float]:
    """Weights and constant of largest likelihood."""
    x = torch.cat([torch.nn.functional.pad(each.double(), (0, 1), value=1.0) for each in features])
    weight = torch.cat([torch.full_like(each, 1 / len(each)) for each in right])
    target, found = torch.cat(right), torch.zeros(x.shape[1], dtype=torch.float64)
    for _ in range(ITERATIONS):
        p = torch.sigmoid(x @ found)
        H = (x * (weight * p * (1 - p))[:, None]).mT @ x
        found = found - torch.linalg.solve(H, x.mT @ (weight * (p - target)))
    return [round(float(each), 2) for each in found]


def main() -> None:
    found = []
    for text in sys.argv[1:]:
        folder, _, depth = text.partition("=")
        found.append(samples(Path(folder), Path(depth) if depth else None))
    print("ALONE", fit([each[0][::2] for each in found], [each[1][::2] for each in found]))
    print("TOGETHER", fit([each[2][::2] for each in found], [each[3][::2] for each in found]))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
