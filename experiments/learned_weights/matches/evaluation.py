"""Errors of poses, and the methods that learned weights compete with."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.learned_weights.matches.problems import RANSAC_PX, Problems
from experiments.learned_weights.matches.weighting import (
    MatchWeights,
    propagated_variances,
    refine,
    refine_learned,
)
from torchslam.geometry import transform
from torchslam.geometry.robust import Kernel
from torchslam.learning.losses import pose_errors

KERNELS: tuple[Kernel, ...] = ("huber", "cauchy", "geman_mcclure", "truncated")
SCALES = (1.0, 2.0, 4.0)
ORACLE_PX = 1.5  # of the keypoint's level
_CHUNK = 64


def relative_errors(errors: Tensor, problems: Problems) -> Tensor:
    """(..., P) one number for (..., P, 2): root of the squares of distance over the scene's depth, and angle."""
    return torch.hypot(errors[..., 0] / problems.depths, errors[..., 1])


@dataclass(frozen=True)
class FixedKernel:
    """Refinement with one kernel for all; weights are one, or 1 / scale^2 of the keypoint's level."""

    kernel: Kernel
    scale: float
    by_level: bool = False

    def __call__(self, problems: Problems) -> Tensor:
        weights = 1 / problems.cues.scales_query.square() if self.by_level else None
        return refine(problems, weights, self.kernel, self.scale).T_cw

    def __str__(self) -> str:
        weights = "1/scale² of the pyramid level" if self.by_level else "one"
        return f"{self.kernel}, scale {self.scale:g}, weights {weights}"


@dataclass(frozen=True)
class Propagated(FixedKernel):
    """Refinement with the inverse of the variance that follows from the triangulation: weights by hand."""

    def __call__(self, problems: Problems) -> Tensor:
        weights = 1 / propagated_variances(problems, problems.T_start)
        return refine(problems, weights, self.kernel, self.scale).T_cw

    def __str__(self) -> str:
        return f"{self.kernel}, scale {self.scale:g}, weights from propagated variances"


@dataclass(frozen=True)
class Ransac:
    """RANSAC alone, which ends in least squares over its inliers."""

    threshold: float

    def __call__(self, problems: Problems) -> Tensor:
        return problems.T_ransac[:, RANSAC_PX.index(self.threshold)]

    def __str__(self) -> str:
        return f"threshold {self.threshold:g} px"


@dataclass(frozen=True)
class Learned:
    network: MatchWeights

    def __call__(self, problems: Problems) -> Tensor:
        return refine_learned(self.network, problems)[-1].T_cw


@dataclass(frozen=True)
class Oracle:
    """Least squares over the matches that agree with the true pose, unknown in practice: a lower bound of the error.

    It also picks, among matches of equal quality, those whose noise happens to point towards the truth.
    """

    def __call__(self, problems: Problems) -> Tensor:
        projected, valid = problems.camera.project(transform(problems.T_true, problems.points))
        residuals = (projected - problems.pixels).norm(dim=-1) / problems.cues.scales_query
        weights = (valid & (residuals < ORACLE_PX)) / problems.cues.scales_query.square()
        return refine(problems, weights, "none", start=problems.T_true).T_cw


Method = FixedKernel | Ransac | Learned | Oracle
UNIFORM = FixedKernel("cauchy", 1.0)


def candidates() -> dict[str, list[Method]]:
    """Per competitor, all its settings; the training part chooses."""
    grid = list(itertools.product(KERNELS, SCALES))
    return {
        "uniform weights": [UNIFORM],
        "best kernel": [FixedKernel(*choice, by_level=level) for choice in grid for level in (False, True)],
        "RANSAC": [Ransac(threshold) for threshold in RANSAC_PX],
        "by hand": [Propagated(*choice) for choice in grid],
    }


@torch.no_grad()
def poses_of(method: Method, problems: Problems) -> Tensor:
    """(P, 4, 4) base to query."""
    parts = [problems[start : start + _CHUNK] for start in range(0, len(problems), _CHUNK)]
    return torch.cat([method(part) for part in parts])


def median_error(method: Method, problems: Problems) -> Tensor:
    """The median relative error against the reference poses."""
    errors = pose_errors(T_cw=poses_of(method, problems), T_cw_groundtruth=problems.T_true)
    return relative_errors(errors, problems).median()


def choose(methods: list[Method], parts: list[Problems], at_most: int = 100) -> Method:
    """The method whose median relative error is lowest, as a geometric mean over parts.

    Takes `at_most` problems of each part, evenly spaced.
    """
    if len(methods) == 1:
        return methods[0]
    thin = [problems[:: -(-len(problems) // at_most)] for problems in parts]
    return min(methods, key=lambda method: sum(float(median_error(method, part).log()) for part in thin))
