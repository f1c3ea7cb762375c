"""How each observation of a bundle adjustment pulls at the camera, frames and points eliminated."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry.precision import full_precision
from torchslam.optim._core.options import SolverOptions
from torchslam.optim._core.residuals import variance_factor
from torchslam.optim.bundle._minimization import BundleMinimization
from torchslam.optim.bundle._problem import BundleData, BundleEstimate, BundleProblem, sanitized
from torchslam.optim.bundle._schur import BundleTangent
from torchslam.optim.bundle._sparse import SparseBundle


class CameraScores(NamedTuple):
    """The efficient scores of the camera, by observation that counts.

    Attributes:
        scores: the share of an observation in the slope of the cost along the directions of the camera, downhill,
            where frames and points follow the camera to their minimum.
        information: its share in the Gauss-Newton Hessian of that cost.
        frame_index: rows of the problem's `T_cw`.
        point_index: rows of its `points_w`.
        variance: variance of an observation by the residuals, in units of the stated one.
    """

    scores: Float[Tensor, "O n"]
    information: Float[Tensor, "O n n"]
    frame_index: Int[Tensor, " O"]
    point_index: Int[Tensor, " O"]
    variance: Float[Tensor, ""]


@full_precision
@torch.no_grad()
def camera_scores(
    problem: BundleProblem, directions: Float[Tensor, "P n"], options: SolverOptions
) -> CameraScores | None:
    """The scores of a single camera in a bundle adjustment that is at its minimum, or near it. Detached.

    A step of the camera along the directions moves frames and points to the minimum that then is theirs; M is what an
    observation sees of all three. Its score is -M^T W r, which no step of frames and points changes: errors of the
    observations reach the camera by nothing else, to first order.
    Source: Bickel et al., "Efficient and adaptive estimation for semiparametric models", 1993, section 2.4.

    Args:
        problem: one bundle adjustment with one camera; what it has of priors and factors is left out.
        directions: in which the camera's parameters may move.
        options: its kernel and scale.

    Returns:
        The scores; None where the observations do not determine the directions.
    """
    bundle, estimate = observations_alone(problem, directions, options)
    lin, J, rays_w, factorized = bundle.linear_system(estimate)
    layout, n = bundle.layout, directions.shape[1]
    if not bool(factorized.reduced.definite):
        return None
    none = factorized.equations.gradient
    none = BundleTangent(*(torch.zeros_like(part) for part in none))
    columns = [
        factorized.solve(none._replace(cameras=unit[None]))
        for unit in torch.eye(n, dtype=directions.dtype, device=directions.device)
    ]
    # The camera's block of the inverse, by which the steps of frames and points are those of a step by one.
    block = torch.linalg.inv(torch.stack([column.cameras[0] for column in columns], dim=-1))
    frames, points = (
        torch.stack([column[part] for column in columns], dim=-1) @ block for part in range(2)
    )  # (K', 6, n), (N, 3, n)
    moved = frames.new_zeros(len(estimate.T_cw), 6, n).index_copy(0, layout.free_frames, frames)
    moved = moved[layout.frame_index]
    rays_w = rays_w.mT[..., None].expand(-1, -1, n)
    velocity = moved[:, :3] + torch.linalg.cross(moved[:, 3:], rays_w, dim=1) + points[layout.point_index]
    J = J.permute(2, 0, 1)
    M = J[..., :3] @ velocity + J[..., 3:]
    scores = -(M.mT @ lin.gradient_wrt_residual[..., None])[..., 0]
    unknowns = 6 * len(layout.free_frames) + 3 * int(layout.free_points.sum()) + n
    return CameraScores(
        scores,
        M.mT @ (lin.weight[:, None, None] * M),
        layout.frame_index,
        layout.point_order[layout.point_index],
        variance_factor(bundle.observations, lin, unknowns),
    )


def observations_alone(
    problem: BundleProblem, directions: Float[Tensor, "P n"] | None, options: SolverOptions
) -> tuple[SparseBundle, BundleEstimate]:
    """One bundle adjustment with one camera without what it has of priors and factors, and its start, both in the
    order of the layout; directions: in which the camera's parameters may move."""
    problem = replace(problem, camera_prior=None, pose_prior=None, depth_prior=None, frame_factors=())
    given = sanitized(problem, options.scale)
    free = False if directions is None else directions
    minimization = BundleMinimization(
        problem.camera, options.kernel, free, 0, 0.0, None, False, given.weights.ndim > 3
    )
    ((_, bundle),) = minimization.formulations(BundleData(*given))
    assert isinstance(bundle, SparseBundle), "one problem is solved by sparse algebra"
    return bundle, bundle.ordered(BundleEstimate(given.T_cw, given.points_w, given.params))
