"""What other weights do to the very same observations: the graph of a run by the hand-set rule, solved anew."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from experiments.noise_model.consistency import aligned_covariance, consistency
from experiments.noise_model.graphs import LEAST_KNOWN, Example
from experiments.noise_model.model import NoiseModel
from experiments.noise_model.training import (
    halves,
    negative_log_likelihood,
    residuals,
    solved,
    weighed,
)
from torchslam.evaluation import ate
from torchslam.geometry import se3_inverse
from torchslam.geometry.alignment import umeyama
from torchslam.optim.run_graph import solve

SPLITS = 5


@dataclass(frozen=True)
class Figures:
    """ate_m: of the keyframes; nees, ratio: as in `Consistency`; none of these where too few true poses are known.

    apart:  of some splits, how far the keyframes of two random halves of the points are apart, root mean square after
            alignment, in metres where the truth is known
    nees_halves: squared, as a share of what their covariances say
    loss:   negative log likelihood of an observation, None for what says nothing of how large errors are
    """

    ate_m: float | None
    nees: float | None
    ratio: float | None
    apart: list[float]
    nees_halves: float
    loss: float | None

    @property
    def noise_share(self) -> float | None:
        """Of the squared ATE: what differs between halves, of which each errs twice as much, squared, as the whole."""
        if self.ate_m is None:
            return None
        return sum(each**2 for each in self.apart) / len(self.apart) / 4 / self.ate_m**2


@torch.no_grad()
def figures_of(example: Example, model: NoiseModel | None, file: Path, splits: int = SPLITS) -> Figures:
    """Of a run's keyframes by a model's information or by the hand-set rule; kept in `file`."""
    if file.exists():
        return Figures(**json.loads(file.read_text()))
    informed = example if model is None else weighed(example, model)
    informed = solved(informed)
    known, has_truth = example.known, int(example.known.sum()) >= LEAST_KNOWN
    found = consistency(informed.graph, example.T_cw, known) if has_truth else None
    unit = scale_of(informed.graph.T_cw[known], example.T_cw[known]) if has_truth else 1.0
    pairs = [apart(halves(informed, seed)) for seed in range(splits)]
    loss = None
    if model is not None and model.level_of_image == 0:
        loss = float(negative_log_likelihood(model, residuals(example, informed)))
    figures = Figures(
        float(ate(informed.graph.T_cw[known], example.T_cw[known])) if has_truth else None,
        found.nees if found else None,
        found.ratio if found else None,
        [unit * distance for distance, _ in pairs],
        sum(nees for _, nees in pairs) / splits,
        loss,
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(asdict(figures)))
    return figures


def scale_of(T_cw: Tensor, truth: Tensor) -> float:
    """Metres per unit of the map."""
    return float(umeyama(se3_inverse(T_cw)[:, :3, 3], se3_inverse(truth)[:, :3, 3])[0])


def apart(parts: list[Example]) -> tuple[float, float]:
    """How far two solutions are apart, in units of the map, and squared as a share of what covariances say."""
    solutions = [solve(part.graph, backward="detached") for part in parts]
    both = solutions[0].success & solutions[1].success
    first, second = (se3_inverse(each.T_cw)[both, :3, 3] for each in solutions)
    s, R, t = umeyama(second, first)
    squared = (s * second @ R.mT + t - first).square().sum()
    # Each of the two has a covariance in units of its own.
    spreads = [aligned_covariance(solved(part).graph, both).trace() for part in parts]
    return float((squared / both.sum()).sqrt()), float(squared / (spreads[0] + s.square() * spreads[1]))
