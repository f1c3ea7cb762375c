"""A pose to start a refinement from, for every frame of a run: `estimate_absolute_pose` of one frame, in few calls."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry.absolute_pose import (
    CANDIDATES,
    FINAL_ITERATIONS,
    FINAL_WIDTH,
    FIRST_ROUND,
    LOCAL_ITERATIONS,
    is_success,
    unit_rays,
)
from torchslam.geometry.local_optimization import State
from torchslam.geometry.p3p import p3p
from torchslam.geometry.precision import full_precision
from torchslam.geometry.projections import fit_projections, pose_tangent, squared_projections
from torchslam.geometry.ransac import SUPPORT_WIDTH, sample_minimal_of_all, search
from torchslam.geometry.undistorted import UndistortedKeypoints


@full_precision
@torch.no_grad()
def start_pose(
    points_w: Tensor,
    undistorted: UndistortedKeypoints,
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
    if len(points_w) < 4:
        return None
    centre = points_w.mean(0)
    problem = _Problem.of(points_w - centre, undistorted, threshold)
    generator = torch.Generator().manual_seed(seed)
    (P,) = search(
        lambda _, count: problem.propose(count, generator),
        problem.mask.sum(-1),
        3,
        confidence,
        FIRST_ROUND,
        max_samples,
    )
    P = problem.fit(P[None], FINAL_ITERATIONS, FINAL_WIDTH)[0][0]
    inliers = problem.squared_errors(P) < 1
    if not bool(is_success(inliers[None], problem.mask, problem.points[None], size, threshold)):
        return None
    T_cw = torch.eye(4, dtype=P.dtype, device=P.device)
    T_cw[:3] = P
    T_cw[:3, 3] -= P[:, :3] @ centre
    return T_cw


@dataclass(frozen=True)
class _Problem:
    """What hypotheses are made of and asked for; points are relative to their mean: float32 is enough for scores.

    points: (N, 3); rays: (N, 3) of unit length; homogeneous: (1, 4, N); xy: (1, N, 2); scale: (1, N, 1) thresholds per
    unit of xy; mask: (1, N), of all
    """

    points: Tensor
    rays: Tensor
    homogeneous: Tensor
    xy: Tensor
    scale: Tensor
    mask: Tensor

    @classmethod
    def of(cls, points: Tensor, undistorted: UndistortedKeypoints, threshold: float) -> _Problem:
        ones, xy = torch.ones_like(points[:, :1]), undistorted.xy.mT
        scale = undistorted.pixel_scale / threshold
        homogeneous = torch.cat((points, ones), dim=1).mT
        mask = torch.ones_like(scale[None], dtype=torch.bool)
        return cls(points, unit_rays(xy), homogeneous[None], xy[None], scale[None, :, None], mask)

    def propose(self, count: int, generator: torch.Generator) -> tuple[State, Tensor, Tensor]:
        """The best pose (1, 3, 4) from `count` minimal samples, optimised, its score (1,) and support (1,)."""
        rows = sample_minimal_of_all(len(self.points), 3, count, generator).to(self.points.device)
        R, t, valid = p3p(self.rays[rows], self.points[rows])
        P = torch.cat((R, t[..., None]), dim=-1)[valid]
        if len(P) == 0:
            nobody = torch.zeros_like(self.xy[:, 0, 0])
            return (P.new_zeros(1, 3, 4),), nobody - torch.inf, nobody
        squared = squared_projections(
            P.float()[None], self.homogeneous.float(), self.xy.float(), self.scale.float()
        )
        costs = squared[0].clamp_max_(1.0).nan_to_num_(1.0).sum(1)
        best = P[costs.topk(min(CANDIDATES, len(P)), largest=False).indices][None]
        P, cost = self.fit(best, LOCAL_ITERATIONS)
        cost, row = cost.nan_to_num(torch.inf).min(dim=0, keepdim=True)
        support = (self.squared_errors(P[row][0]) < SUPPORT_WIDTH**2).sum(0, keepdim=True)
        return (P[row],), -cost, support

    def fit(self, P: Tensor, iterations: int, width: float = 1.0) -> tuple[Tensor, Tensor]:
        """Poses (K, 3, 4) and costs (K,) of those (1, K, 3, 4), optimised on what agrees with them.

        width: thresholds within which that is
        """
        tangent = pose_tangent(P.dtype, P.device)
        found = self.homogeneous, self.xy, self.scale
        P, cost = fit_projections(P, tangent, *found, self.mask, iterations, width)
        return P[0], cost[0]

    def squared_errors(self, P: Tensor) -> Tensor:
        """(N,) squared errors of a pose (3, 4) in thresholds; infinite or NaN behind the camera."""
        return squared_projections(P[None, None], self.homogeneous, self.xy, self.scale)[0, 0]
