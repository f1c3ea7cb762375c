"""The oldest frames of a window as a prior of the others: what they and their points say is not lost.

Source: Sibley, Matthies and Sukhatme, "Sliding window filter with application to planetary landing", 2010.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry.precision import full_precision
from torchslam.optim._core.levenberg_marquardt import BUNDLE_OPTIONS, SolverOptions
from torchslam.optim._core.residuals import ReprojectionData, linearize
from torchslam.optim._core.tangent import PosePrior, point_jacobian, prior_expansion, row_jacobian
from torchslam.optim.bundle._factors import Factors, factor_kinds, moved_errors, pose_error
from torchslam.optim.bundle._problem import BundleProblem, sanitized, select_moving
from torchslam.utils.indexing import row_mask

_RANK = 1e-10
"""Share of the largest eigenvalue of a prior below which a direction, such as the scale, counts as undetermined. Tried
at this value only."""


def joint_pose_error(*poses_and_measured: Tensor) -> Tensor:
    """Errors (..., 6 n) of n poses, each as of `pose_error`, minus their mean; measured (..., 22 n): the poses at which
    they were linearized, then the mean."""
    *poses, measured = poses_and_measured
    split = 16 * len(poses)
    at = measured[..., :split].unflatten(-1, (len(poses), 4, 4))
    errors = [pose_error(T_cw, at[..., number, :, :]) for number, T_cw in enumerate(poses)]
    return torch.cat(errors, dim=-1) - measured[..., split:]


@full_precision
def marginalize(
    problem: BundleProblem,
    frames: Int[Tensor, " M"] | Sequence[int],
    *,
    options: SolverOptions = BUNDLE_OPTIONS,
) -> BundleProblem:
    """Replace frames, and all points that they see, by a prior of the other frames that see these points.

    The prior is one of `Factors`, Gaussian at the poses of `problem`, which should be those of its minimum; it keeps
    them, however the window moves on. The minimum of the rest is then the same. Observations of the removed points
    are part of the prior, those of the others stay. Differentiable with respect to all of the problem.

    Args:
        problem: one, with one camera, which the prior takes as exact; factors of removed frames become part of the
            prior.
        frames: rows of T_cw that are removed.
        options: kernel and scale, as of `solve_bundle`.

    Returns:
        The problem of the other frames and points, in their order.

    Raises:
        ValueError: the problem is a batch, has several cameras or depths, or a factor of a removed point.
    """
    if problem.is_batch or problem.camera_index is not None or problem.depth_prior is not None:
        raise ValueError("marginalize takes one problem with one camera and without depths")
    given = sanitized(problem, options.scale)
    moving = select_moving(given, factor_kinds(problem.factors))
    counted, free, free_points = (mask[0] for mask in moving)
    T_cw, points_w, frame_index, point_index = (
        problem.T_cw,
        problem.points_w,
        given.frame_index[0],
        given.point_index[0],
    )
    old = row_mask("frames", frames, T_cw[None, :, 0, 0])[0]
    gone = torch.zeros_like(free_points).index_fill(0, point_index[counted & old[frame_index]], True)
    own, own_factors, other_factors = _split_factors(problem.factors, old, gone)

    rows = (counted & gone[point_index]).nonzero().squeeze(-1)
    seen, where = frame_index[rows], point_index[rows]
    involved = torch.zeros_like(free).index_fill(0, seen, True)
    for each in own:
        involved = involved.index_fill(0, each.frames.flatten(), True)
    kept, removed = (free & involved & ~old).nonzero()[:, 0], (free & old).nonzero()[:, 0]
    variables = torch.cat((kept, removed))
    slots = torch.full_like(free, -1, dtype=torch.int64)
    slots[variables] = torch.arange(len(variables), device=slots.device)
    points = (gone & free_points).nonzero()[:, 0]
    places = torch.full_like(gone, -1, dtype=torch.int64)
    places[points] = torch.arange(len(points), device=places.device)

    T_seen = T_cw[seen]
    points_c = (T_seen[:, :3, :3] @ points_w[where, :, None]).squeeze(-1) + T_seen[:, :3, 3]
    observed = ReprojectionData(
        given.pixels[0, rows], given.weights[0, rows], problem.camera, options.kernel, given.scale[0]
    )
    lin = linearize(observed, points_c)
    width = 6 * len(variables)
    J = lin.J.new_zeros(len(rows), 2, width + 3 * len(points))
    J = _put(J, lin.J @ point_jacobian(points_c), 6 * slots[seen])
    J = _put(J, lin.J @ T_seen[:, :3, :3], torch.where(places[where] >= 0, width + 3 * places[where], -1))
    weighted = lin.weight[:, None, None] * J
    hessian = torch.einsum("ori,orj->ij", weighted, J)
    gradient = torch.einsum("ori,or->i", weighted, lin.residual)
    for each in own:
        (kind,) = factor_kinds([each])
        moved = moved_errors(kind, (T_cw, points_w, problem.camera.params[None]), each.measured)
        zero = T_cw.new_zeros(len(each.frames), 6 * each.frames.shape[1])
        blocks = row_jacobian(moved, zero)
        J = blocks.new_zeros(*blocks.shape[:2], len(gradient))
        for number, column in enumerate(each.frames.unbind(1)):
            J = _put(J, blocks[..., 6 * number : 6 * number + 6], 6 * slots[column])
        pulled = J.mT @ each.information
        hessian, gradient = (
            hessian + (pulled @ J).sum(0),
            gradient + (pulled @ moved(zero)[..., None]).sum((0, 2)),
        )
    if problem.pose_prior is not None and len(removed):
        prior = PosePrior(problem.pose_prior.T_cw[removed], problem.pose_prior.information[removed])
        _, slope, blocks = prior_expansion(prior, T_cw[removed])
        begin = 6 * len(kept)
        gradient = torch.cat((gradient[:begin], gradient[begin:width] + slope.flatten(), gradient[width:]))
        padding = begin, len(gradient) - width
        hessian = hessian + torch.nn.functional.pad(torch.block_diag(*blocks), padding * 2)
    prior_factor = _prior(kept, T_cw[kept], hessian, gradient)
    return _rest(problem, old, gone, [*own_factors, *other_factors, *prior_factor])


def _put(J: Tensor, blocks: Tensor, starts: Tensor) -> Tensor:
    """Blocks (M, r, n) in the columns of J (M, r, D) from `starts` (M,) on; none where it is below zero."""
    used = (starts >= 0).nonzero().squeeze(-1)
    columns = starts[used, None] + torch.arange(blocks.shape[2], device=J.device)
    spread = columns[:, None].expand(len(used), blocks.shape[1], -1)
    return J.index_add(0, used, torch.zeros_like(J[used]).scatter(2, spread, blocks[used]))


def _split_factors(
    factors: Sequence[Factors], old: Tensor, gone: Tensor
) -> tuple[list[Factors], list[Factors], list[Factors]]:
    """The factors of old frames; the rest of these; and those of points and the camera."""
    own, rest, others = list[Factors](), list[Factors](), list[Factors]()
    for each in factors:
        if each.points is not None or each.of_camera:
            if each.points is not None and (bool(gone[each.points].any()) or bool(old[each.frames].any())):
                raise ValueError("a factor of points that are removed cannot be marginalized")
            others.append(each)
            continue
        touched = old[each.frames].any(1)
        for part, mask in ((own, touched), (rest, ~touched)):
            if bool(mask.any()):
                columns = each.frames[mask], each.measured[mask], each.information[mask]
                part.append(Factors(*columns, each.error))
    return own, rest, others


def _prior(
    kept: Tensor, T_cw: Float[Tensor, "n 4 4"], hessian: Float[Tensor, "D D"], gradient: Float[Tensor, " D"]
) -> list[Factors]:
    """The joint prior of the kept frames, whose numbers come first, with all others eliminated."""
    if not len(kept):
        return []
    size = 6 * len(kept)
    right = torch.cat((hessian[size:, :size], gradient[size:, None]), dim=1)
    solved = hessian[:size, size:] @ torch.linalg.solve(hessian[size:, size:], right)
    information = hessian[:size, :size] - solved[:, :size]
    information = 0.5 * (information + information.mT)
    slope = gradient[:size] - solved[:, size]
    mean = -torch.linalg.pinv(information, rtol=_RANK, hermitian=True) @ slope
    measured = torch.cat((T_cw.flatten(), mean))
    return [Factors(kept[None], measured[None], information[None], joint_pose_error)]


def _rest(problem: BundleProblem, old: Tensor, gone: Tensor, factors: Sequence[Factors]) -> BundleProblem:
    """The problem without old frames and gone points."""
    frames, points = (torch.where(~mask, (~mask).cumsum(0) - 1, -1) for mask in (old, gone))
    rows = (~old[problem.frame_index] & ~gone[problem.point_index]).nonzero().squeeze(-1)
    changes = {
        name: getattr(problem, name)[rows]
        for name in ("pixels", "weights", "mask")
        if getattr(problem, name) is not None
    }
    prior = problem.pose_prior
    if prior is not None:
        prior = PosePrior(prior.T_cw[~old], prior.information[~old])
    fixed = row_mask("fixed_frames", problem.fixed_frames, problem.T_cw[None, :, 0, 0])[0]
    fixed_points = row_mask("fixed_points", problem.fixed_points, problem.points_w[None, :, 0])[0]
    return replace(
        problem,
        T_cw=problem.T_cw[~old],
        points_w=problem.points_w[~gone],
        frame_index=frames[problem.frame_index[rows]],
        point_index=points[problem.point_index[rows]],
        fixed_frames=fixed[~old],
        fixed_points=fixed_points[~gone],
        pose_prior=prior,
        factors=[
            replace(
                each, frames=frames[each.frames], points=None if each.points is None else points[each.points]
            )
            for each in factors
        ],
        **changes,
    )
