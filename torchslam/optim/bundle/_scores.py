"""How each observation of a bundle adjustment pulls at the camera, and each point at the poses.

Frames and points, or the points, are eliminated. How far these slopes of the cost, the scores, scatter is the error of
the camera and of the poses, however the observations of one point depend on each other.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry.precision import full_precision
from torchslam.optim._core.levenberg_marquardt import GRAPH_OPTIONS, SolverOptions
from torchslam.optim._core.residuals import Linearization, flatness, variance_factor
from torchslam.optim.bundle._problem import (
    BundleEstimate,
    BundleProblem,
    MovingParts,
    sanitized,
    select_moving,
)
from torchslam.optim.bundle._schur import BundleTangent, FactorizedEquations, sum_runs
from torchslam.optim.bundle._sparse import (
    EXACT_AT_ONCE,
    SparseBundle,
    SparseLayout,
    build_sparse_layout,
    runs_of,
)


class CameraScores(NamedTuple):
    """The efficient scores of the camera, by observation that counts.

    Attributes:
        scores: the share of an observation in the slope of the cost along the directions of the camera, downhill,
            where frames and points follow the camera to their minimum.
        information: its share in the Gauss-Newton Hessian of that cost.
        frame_index: rows of the problem's `T_cw`; point_index: of its `points_w`.
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

    Priors and factors of the problem are left out. None where the observations do not determine the directions, in
    which the camera's parameters may move.
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
    J = J.permute(2, 0, 1)
    M = torch.cat(
        [
            J[run, :, :3] @ _velocities(layout, estimate, rays_w, frames, points, run) + J[run, :, 3:]
            for run in runs_of(len(J), EXACT_AT_ONCE)
        ]
    )
    scores = -(M.mT @ lin.gradient_wrt_residual[..., None])[..., 0]
    unknowns = 6 * len(layout.free_frames) + 3 * int(layout.free_points.sum()) + n
    return CameraScores(
        scores,
        M.mT @ (lin.weight[:, None, None] * M),
        layout.frame_index,
        layout.point_order[layout.point_index],
        variance_factor(bundle.observations, lin, unknowns),
    )


class FocalScores(NamedTuple):
    """The efficient scores of the focal lengths of frames, by observation that counts.

    Attributes:
        slopes: what an observation sees of a step of the logarithm of each focal length, in whitened pixels, where
            frames, points and the common camera follow it to their minimum.
        residuals: whitened, times `weight`; weight: of each residual by the kernel.
        frame_index, point_index, variance: as of `CameraScores`.
    """

    slopes: Float[Tensor, "O 2 F"]
    residuals: Float[Tensor, "O 2"]
    weight: Float[Tensor, " O"]
    frame_index: Int[Tensor, " O"]
    point_index: Int[Tensor, " O"]
    variance: Float[Tensor, ""]


@full_precision
@torch.no_grad()
def focal_scores(
    problem: BundleProblem,
    shares: Float[Tensor, "K F"],
    directions: Float[Tensor, "P n"],
    options: SolverOptions,
) -> FocalScores | None:
    """The scores of focal lengths of which each frame has its shares, beside those of the common camera. Detached.

    As `camera_scores`, at a minimum of a single camera, whose parameters may move along `directions`, the first of
    which is that of the focal length. None where the observations do not determine them.
    """
    bundle, estimate = observations_alone(problem, directions, options)
    lin, J, rays_w, factorized = bundle.linear_system(estimate)
    layout, structure = bundle.layout, bundle.layout.structure
    if not bool(factorized.reduced.definite):
        return None
    share = shares[layout.frame_index]
    slope = (J * (lin.weight * J[:, 3])[:, None]).sum(0)
    pulls = torch.cat((slope[:3], torch.linalg.cross(rays_w, slope[:3], dim=0)))[:, : structure.num_linked]
    steps = [
        factorized.solve(
            BundleTangent(
                sum_runs(pulls * part[: structure.num_linked], structure.frame_ends),
                structure.sum_by_point((slope[:3] * part).mT),
                structure.sum_by_camera(slope[3:] * part),
            )
        )
        for part in share.mT
    ]
    frames, points = (torch.stack([step[part] for step in steps], dim=-1) for part in range(2))
    camera = torch.stack([step.cameras[0] for step in steps], dim=-1)
    J = J.permute(2, 0, 1)
    slopes = J.new_empty(len(J), 2, shares.shape[1])
    for run in runs_of(len(J), EXACT_AT_ONCE):
        followed = J[run, :, :3] @ _velocities(layout, estimate, rays_w, frames, points, run)
        slopes[run] = J[run, :, 3, None] * share[run, None] - followed - J[run, :, 3:] @ camera
    unknowns = 6 * len(layout.free_frames) + 3 * int(layout.free_points.sum()) + shares.shape[1]
    return FocalScores(
        slopes,
        lin.gradient_wrt_residual,
        lin.weight,
        layout.frame_index,
        layout.point_order[layout.point_index],
        variance_factor(bundle.observations, lin, unknowns),
    )


def _velocities(
    layout: SparseLayout,
    estimate: BundleEstimate,
    rays_w: Float[Tensor, "3 O"],
    frames: Float[Tensor, "k 6 n"],
    points: Float[Tensor, "N 3 n"],
    run: slice,
) -> Float[Tensor, "R 3 n"]:
    """How each of n steps of free frames and points moves the points of a run, seen from their frames."""
    moved = frames.new_zeros(len(estimate.T_cw), *frames.shape[1:])
    moved = moved.index_copy(0, layout.free_frames, frames)[layout.frame_index[run]]
    rays_w = rays_w[:, run].mT[..., None].expand(-1, -1, frames.shape[-1])
    return moved[:, :3] + torch.linalg.cross(moved[:, 3:], rays_w, dim=1) + points[layout.point_index[run]]


@full_precision
@torch.no_grad()
def pose_covariance(
    problem: BundleProblem,
    options: SolverOptions = GRAPH_OPTIONS,
    camera_errors: Float[Tensor, "P n"] | None = None,
) -> Float[Tensor, "D D"]:
    """Joint covariance of the poses of one bundle adjustment with one camera, by the scatter of its points. Detached.

    The covariance of the normal matrix is of errors that are independent and alike. But keypoints of one point err
    alike in all frames, and some points are much worse than others: a corner of two edges at different depths, a leaf,
    a wrong match that the kernel has not removed. The slopes of the points' costs, each point eliminated, sum to zero
    at the minimum, and the scatter of their sum is the error of the poses: only points are independent of each other.
    It takes some tens of points for each free frame; with few, `BundleSolution.covariance` is the better one. Errors
    that all points share, as those of the camera, do not show in how they scatter; those of the camera are added.
    Source: Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986.

    Args:
        problem: at its minimum, or near it; what it has of priors and factors is left out.
        options: its kernel and scale.
        camera_errors: columns of the camera's parameters, each an independent error of one standard deviation, as
            `CameraMeasurement.directions`; None: the camera is exact.

    Returns:
        Of the left perturbations (translation, rotation) of the frames, one after the other, D = 6 K. Rows and columns
        of fixed frames are zero, and all are where the observations do not determine the poses. The scale, and with no
        fixed frame the similarity, have no error.
    """
    bundle, estimate = observations_alone(problem, camera_errors, options)
    lin, J, rays_w, factorized = bundle.linear_system(estimate)
    layout = bundle.layout
    frames, count = layout.free_frames, len(estimate.T_cw)
    covariance = estimate.T_cw.new_zeros(count, 6, count, 6)
    if not len(frames) or not bool(factorized.reduced.definite):
        return covariance.flatten(2).flatten(0, 1)
    scatter = _scatter(bundle, lin, J[:, :3], rays_w, factorized)
    split = 6 * len(frames)
    rows = split + (0 if camera_errors is None else camera_errors.shape[1])
    inverse = factorized.reduced.solve(torch.eye(rows, dtype=J.dtype, device=J.device))
    poses, camera = inverse[:split, :split], inverse[split:, split:]
    # With the camera fixed, and how the poses follow it.
    follows = inverse[:split, split:] @ torch.linalg.inv(camera)
    poses = poses - follows @ inverse[split:, :split]
    poses = flatness(bundle.observations, lin).square() * (poses @ scatter @ poses) + follows @ follows.mT
    R_cw = estimate.T_cw[frames, :3, :3]
    blocks = poses.view(len(frames), 2, 3, len(frames), 2, 3)
    blocks = torch.einsum("aij,aujbvk,blk->abuivl", R_cw, blocks, R_cw).flatten(4).flatten(2, 3)
    covariance[frames[:, None], :, frames[None, :], :] = blocks
    return covariance.flatten(2).flatten(0, 1)


def _scatter(
    bundle: SparseBundle,
    lin: Linearization,
    J: Float[Tensor, "2 3 O"],
    rays_w: Float[Tensor, "3 O"],
    factorized: FactorizedEquations,
) -> Float[Tensor, "D D"]:
    """Sum over points of the outer product of their slopes in the D = 6 K numbers by which free frames move along the
    axes of the world; J: derivatives of the errors in the points."""
    structure = bundle.layout.structure
    by_frame = torch.diff(torch.tensor([0, *structure.frame_ends], device=J.device))
    slots = torch.repeat_interleave(torch.arange(structure.num_frames, device=J.device), by_frame)
    slope = torch.einsum("dco,od->oc", J, lin.gradient_wrt_residual)
    own = structure.sum_by_point(slope)
    turning = torch.linalg.cross(rays_w.mT, slope)
    pulls = torch.cat((slope, turning), dim=-1)[: len(slots)]
    # Observations of free frames, ordered by point.
    point_index = bundle.layout.point_index[: len(slots)]
    order = torch.argsort(point_index, stable=True)
    ends = torch.bincount(point_index, minlength=structure.num_points).cumsum(0)
    size = 6 * structure.num_frames
    total = slope.new_zeros(size, size)
    for tile, (points, rows, A) in zip(structure.tiles, factorized.tiles, strict=True):
        members, height = tile.frames.members, points.stop - points.start
        width = 6 * len(members)
        begin = int(ends[points.start - 1]) if points.start else 0
        seen = order[begin : int(ends[points.stop - 1])]
        cells = (point_index[seen] - points.start) * len(members) + torch.searchsorted(members, slots[seen])
        scores = slope.new_zeros(height * len(members), 6).index_add_(0, cells, pulls[seen])
        # What the point follows: nothing at its minimum.
        halves = (factorized.points_root[points] @ own[points, :, None])[..., 0]
        followed = torch.einsum("pd,pdr->pr", halves, A[:, :width].unflatten(0, (-1, 3)))
        scores = scores.view(height, width) - followed
        total.index_put_((rows[:width, None], rows[None, :width]), scores.mT @ scores, accumulate=True)
    return total


def observations_alone(
    problem: BundleProblem, directions: Float[Tensor, "P n"] | None, options: SolverOptions
) -> tuple[SparseBundle, BundleEstimate]:
    """One bundle adjustment without what it has of priors and factors, and its start, both in the order of the layout;
    directions: in which the parameters of its one camera may move."""
    problem = replace(problem, camera_prior=None, pose_prior=None, depth_prior=None, factors=())
    given = sanitized(problem, options.scale)
    moving, alone = MovingParts(*(mask[0] for mask in select_moving(given))), given.part(0)
    layout = build_sparse_layout(alone, moving, free_camera=directions is not None)
    bundle = SparseBundle(layout, alone, problem.camera, options.kernel, directions, ())
    return bundle, bundle.ordered(BundleEstimate(given.T_cw, given.points_w, given.params))
