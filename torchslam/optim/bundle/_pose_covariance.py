"""How exact the poses of a bundle adjustment are, by how far its points agree.

The covariance that the normal matrix gives is of errors that are independent and alike. But keypoints of one point err
alike in all frames that see it, since they follow the same pattern, and some points are much worse than others: a
corner that two edges at different depths make, a leaf, a wrong match that the kernel has not removed. What counts is
how much each point pulls at the poses: the slopes of its cost, the point eliminated. They sum to zero at the minimum,
and the scatter of their sum is the error of the poses, however the observations of one point depend on each other (the
cluster-robust covariance of Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986).

Errors that all points share, as those of the camera, do not show in how they scatter. Those of the camera are added:
the poses follow it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.precision import full_precision
from torchslam.optim._core.options import GRAPH_OPTIONS, SolverOptions
from torchslam.optim._core.residuals import Linearization, flatness
from torchslam.optim.bundle._camera_scores import observations_alone
from torchslam.optim.bundle._problem import BundleProblem
from torchslam.optim.bundle._schur import FactorizedEquations
from torchslam.optim.bundle._sparse import SparseBundle


@full_precision
@torch.no_grad()
def pose_covariance(
    problem: BundleProblem,
    options: SolverOptions = GRAPH_OPTIONS,
    camera_errors: Float[Tensor, "P n"] | None = None,
) -> Float[Tensor, "D D"]:
    """Joint covariance of the poses of one bundle adjustment with one camera, by the scatter of its points. Detached.

    Points are independent of each other, the observations of one point need not be. It takes some tens of points for
    each free frame to say how they scatter; with few, `BundleSolution.covariance` is the better one.

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
        return covariance.view(6 * count, 6 * count)
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
    blocks = torch.einsum("aij,aujbvk,blk->auibvl", R_cw, blocks, R_cw).reshape(
        len(frames), 6, len(frames), 6
    )
    covariance[frames[:, None], :, frames[None, :], :] = blocks.transpose(1, 2)
    return covariance.view(6 * count, 6 * count)


def _scatter(
    bundle: SparseBundle,
    lin: Linearization,
    J: Float[Tensor, "2 3 O"],
    rays_w: Float[Tensor, "3 O"],
    factorized: FactorizedEquations,
) -> Float[Tensor, "D D"]:
    """Sum over points of the outer product of their slopes in the D = 6 K numbers by which free frames move.

    All in the axes of the world.

    Args:
        J: derivatives of the errors in the points.
    """
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
