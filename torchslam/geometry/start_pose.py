"""A pose to start a refinement from, for every frame of a run: `estimate_absolute_pose` of one frame, in few calls."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry.p3p import p3p
from torchslam.geometry.precision import full_precision
from torchslam.geometry.projections import fit_projections, pose_tangent, squared_projections
from torchslam.geometry.ransac import SUPPORT_WIDTH
from torchslam.geometry.undistorted import Undistorted

_FIRST_ROUND = 160  # samples, then twice as many; with 64, frames of sheared and blurred images are lost
_CANDIDATES = 2  # hypotheses of each round that are optimised
_LOCAL_ITERATIONS, _FINAL_ITERATIONS = 1, 10
_FINAL_WIDTH = 1.5  # thresholds, for the tail of the noise; without the last optimisation more runs are lost
_ON_A_LINE = 1e-6  # of the largest variance of the points: the second is no more than rounding
_FALSE_ALARMS = 1e-3  # expected among wrong matches
_SOLUTIONS = 4  # of P3P


@full_precision
@torch.no_grad()
def start_pose(
    points_w: Tensor,
    undistorted: Undistorted,
    size: tuple[int, int],
    threshold: float,
    seed: int = 0,
    confidence: float = 0.9999,
    max_samples: int = 3000,
) -> Tensor | None:
    """The pose (4, 4) that explains most matches, by RANSAC over P3P, optimised on them; None where matches that
    are wrong could agree as well, or those that agree are on a line.

    points_w: (N, 3), and where they are seen, all finite; size: of the image; threshold: of an inlier, pixels

    Errors are those of undistorted coordinates, in pixels at each keypoint. The same arguments and seed give the same
    result. Sources: as `estimate_absolute_pose`.
    """
    N = len(points_w)
    if N < 4:
        return None
    centre = points_w.mean(0)
    search = _Search.of(points_w - centre, undistorted, threshold)
    generator = torch.Generator().manual_seed(seed)
    drawn, count, least, needed = 0, _FIRST_ROUND, math.inf, math.inf
    while drawn < min(needed, max_samples):
        count = min(count, max_samples - drawn)
        found, cost = search.propose(count, generator)
        drawn, count = drawn + count, 2 * count
        if cost < least:
            P, least = found, cost
            squared = search.squared_errors(P)
            near, agrees = squared < SUPPORT_WIDTH**2, squared < 1
            support, inliers = torch.stack((near, agrees)).sum(1).tolist()
            needed = _samples_needed(support / N, confidence)
    if least == math.inf:
        return None
    P = search.fit(P[None, None], _FINAL_ITERATIONS, _FINAL_WIDTH)[0][0]
    agrees = search.squared_errors(P) < 1
    inliers = int(agrees.sum())
    chance = math.pi * threshold**2 / (size[0] * size[1])
    if not _is_significant(inliers, N, chance) or _is_on_a_line(search.points[agrees]):
        return None
    T_cw = torch.eye(4, dtype=P.dtype, device=P.device)
    T_cw[:3] = P
    T_cw[:3, 3] -= P[:, :3] @ centre
    return T_cw


@dataclass(frozen=True)
class _Search:
    """What hypotheses are made of and asked for; points are relative to their mean: float32 is enough for scores.

    points: (N, 3); rays: (N, 3) of unit length; homogeneous: (1, 4, N); xy: (1, N, 2); scale: (1, N, 1) thresholds per
    unit of xy
    """

    points: Tensor
    rays: Tensor
    homogeneous: Tensor
    xy: Tensor
    scale: Tensor

    @classmethod
    def of(cls, points: Tensor, undistorted: Undistorted, threshold: float) -> _Search:
        ones, xy = torch.ones_like(points[:, :1]), undistorted.xy.mT
        rays = torch.cat((xy, ones), dim=1)
        rays = rays / torch.linalg.vector_norm(rays, dim=1, keepdim=True)
        scale = undistorted.pixel_scale / threshold
        homogeneous = torch.cat((points, ones), dim=1).mT
        return cls(points, rays, homogeneous[None], xy[None], scale[None, :, None])

    def propose(self, count: int, generator: torch.Generator) -> tuple[Tensor, float]:
        """The best pose (3, 4) from `count` minimal samples, optimised, and its truncated cost; infinite for none."""
        rows = self._samples(count, generator)
        R, t, valid = p3p(self.rays[rows], self.points[rows])
        P = torch.cat((R, t[..., None]), dim=-1)[valid]
        if len(P) == 0:
            return P, math.inf
        squared = squared_projections(
            P.float()[None], self.homogeneous.float(), self.xy.float(), self.scale.float()
        )
        costs = squared[0].clamp_max_(1.0).nan_to_num_(1.0).sum(1)
        best = P[costs.topk(min(_CANDIDATES, len(P)), largest=False).indices][None]
        P, cost = self.fit(best, _LOCAL_ITERATIONS)
        row = int(cost.nan_to_num(torch.inf).argmin())
        return P[row], float(cost[row])

    def _samples(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, 3) rows: random permutations, on the CPU as every device is to draw the same, cut into samples."""
        each = len(self.points) // 3
        order = torch.rand(-(-count // each), len(self.points), generator=generator).argsort(1)
        return order[:, : 3 * each].reshape(-1, 3)[:count].to(self.points.device)

    def fit(self, P: Tensor, iterations: int, width: float = 1.0) -> tuple[Tensor, Tensor]:
        """Poses (K, 3, 4) and costs (K,) of those (1, K, 3, 4), optimised on what agrees with them.

        width: thresholds within which that is
        """
        mask = torch.ones_like(self.xy[..., 0], dtype=torch.bool)
        tangent = pose_tangent(P.dtype, P.device)
        found = self.homogeneous, self.xy, self.scale
        P, cost = fit_projections(P, tangent, *found, mask, iterations, width)
        return P[0], cost[0]

    def squared_errors(self, P: Tensor) -> Tensor:
        """(N,) squared errors of a pose (3, 4) in thresholds; infinite or NaN behind the camera."""
        return squared_projections(P[None, None], self.homogeneous, self.xy, self.scale)[0, 0]


def _samples_needed(share: float, confidence: float) -> float:
    """As `ransac.samples_needed`, of three rows."""
    clean = min(max(share, 1e-6), 1 - 1e-6) ** 3
    return math.log(1 - confidence) / math.log1p(-min(clean, 1 - 1e-6))


def _is_significant(inliers: int, available: int, chance: float) -> bool:
    """As `ransac.is_significant`, for samples of three rows."""
    if inliers <= 3:
        return False
    # available over inliers times inliers over three, but for what cancels
    choices = math.lgamma(available + 1) - math.lgamma(available - inliers + 1) - math.lgamma(inliers - 2)
    alarms = choices - math.lgamma(4) + (inliers - 3) * math.log(min(max(chance, 1e-12), 1.0))
    return alarms + math.log(_SOLUTIONS * max(available - 3, 1)) < math.log(_FALSE_ALARMS)


def _is_on_a_line(points: Tensor) -> bool:
    """Whether points (n, 3) are, and so leave the pose a way to turn."""
    centred = points - points.mean(0)
    variances = torch.linalg.eigvalsh(centred.mT @ centred).tolist()
    return not variances[1] > _ON_A_LINE * variances[2]
