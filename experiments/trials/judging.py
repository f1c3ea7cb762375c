"""Which poses are wrong? Those that a similarity, fitted to the majority, does not bring near the truth."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.geometry import so3_log, umeyama

FAR = 0.3
"""Share of the extent of the true path beyond which a position is wrong."""
TURNED_DEG = 10.0
"""Degrees beyond the median rotation error at which a rotation is wrong."""
MIN_JUDGED = 4
"""Minimum number of poses; fewer fit any path."""
STANDS = 1e-3
"""Share of the extent: frames whose true positions are nearer to the last one before count as one for the fit, as a
camera that stands longer than it moves would be a majority that does not determine the scale."""
SAMPLES, SAMPLE_SIZE, REFITS, NEAR = 200, 8, 5, 3.0  # near: in medians of the residuals


def extent(positions: Tensor) -> float:
    """Root mean square distance of positions (n, 3) from their mean."""
    return float((positions - positions.mean(0)).square().sum(-1).mean().sqrt())


def robust_similarity(source: Tensor, target: Tensor, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Scale, R (3, 3), t (3,) from source to target (n, 3) each, with up to half of the rows wrong.

    The least median of squares of small samples, fitted anew to what is near it. Rousseeuw, "Least median of squares
    regression", 1984.
    """
    n = len(source)
    if n < MIN_JUDGED:
        return umeyama(source, target)
    generator = torch.Generator().manual_seed(seed)
    order = torch.rand(SAMPLES, n, generator=generator).argsort(-1)[:, : min(max(3, n // 2), SAMPLE_SIZE)]
    s, R, t = umeyama(source[order], target[order])
    residuals = (s[:, None, None] * source @ R.mT + t[:, None] - target).norm(dim=-1)
    errors = residuals[residuals.median(-1).values.argmin()]
    best = umeyama(source, target)
    for _ in range(REFITS):
        best = umeyama(source, target, errors <= (NEAR * errors.median()).clamp(min=1e-9))
        errors = (best[0] * source @ best[1].mT + best[2] - target).norm(dim=-1)
    return best


def moves(positions: Tensor, distance: float) -> Tensor:
    """(k,) rows of positions (n, 3) that are further than a distance from the last one taken before, and the first."""
    rows, last = [0], positions[0]
    for row, position in enumerate(positions):
        if float((position - last).norm()) > distance:
            rows.append(row)
            last = position
    return torch.tensor(rows)


def wrong(T_wc: Tensor, truth_wc: Tensor, path_extent: float) -> Tensor:
    """(n,) bool which of the poses T_wc (n, 4, 4), of one submap, are wrong.

    truth_wc: (n, 4, 4) their true poses, in the order of time; path_extent: of the whole true path
    """
    if len(T_wc) < MIN_JUDGED:
        return torch.zeros(len(T_wc), dtype=torch.bool)
    positions, truth = T_wc[:, :3, 3], truth_wc[:, :3, 3]
    rows = moves(truth, STANDS * path_extent)
    s, R, t = _fit_to_right(positions[rows], truth[rows], FAR * path_extent)
    errors = (s * positions @ R.mT + t - truth).norm(dim=-1)
    turned = so3_log(truth_wc[:, :3, :3].mT @ R @ T_wc[:, :3, :3]).norm(dim=-1) * (180 / math.pi)
    return (errors > FAR * path_extent) | (turned > turned.median() + TURNED_DEG)


def _fit_to_right(source: Tensor, target: Tensor, far: float) -> tuple[Tensor, Tensor, Tensor]:
    """The similarity that fits all that it brings nearer than `far`, begun with that of the majority.

    That of the majority alone may take the side of one half of a path that drifts, by chance the one or the other.
    """
    s, R, t = robust_similarity(source, target)
    for _ in range(REFITS):
        near = (s * source @ R.mT + t - target).norm(dim=-1) <= far
        if 2 * int(near.sum()) < len(near):
            break
        s, R, t = umeyama(source, target, near)
    return s, R, t
