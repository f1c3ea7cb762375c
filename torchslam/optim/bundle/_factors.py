"""Additional factors: priors of the depth of observed points, and any errors of frames, points or the camera.

They cost half of e^T information e, as priors do, without a robust kernel. A depth adds one row to its observation. An
error of frames adds blocks to the reduced system, one of a point to its block: neither makes a bundle adjustment less
sparse. What joins a point with other points or with frames is a correction of low rank (`_schur`). Derivatives are
those of autograd, of all at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.func import grad, vjp

from torchslam.geometry.lie import se3_inverse, so3_log
from torchslam.geometry.precision import full_precision
from torchslam.optim._core.implicit import tensors_closed_over
from torchslam.optim._core.residuals import ROUNDINGS, Expansion
from torchslam.optim._core.tangent import retract, rotated
from torchslam.utils.torch_internals import in_transform

_AT_ONCE = 1 << 13
"""Copies of errors that one reverse pass differentiates."""

Error = Callable[..., Tensor]
"""error(*T_kw, *points_w, measured) -> (..., F, D), of poses (..., F, 4, 4) and points (..., F, 3), or of the camera's
parameters (..., F, P) in the place of both; each row from its own rows alone."""


@full_precision
def relative_pose_error(
    T_1w: Float[Tensor, "*#batch 4 4"], T_2w: Float[Tensor, "*#batch 4 4"], T_21: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*#batch 6"]:
    """Translation and rotation vector of T_2w @ T_1w^-1 @ T_21^-1."""
    E = T_2w @ se3_inverse(T_21 @ T_1w)
    return torch.cat((E[..., :3, 3], so3_log(E[..., :3, :3])), dim=-1)


@full_precision
def log_distance_error(
    T_1w: Float[Tensor, "*#batch 4 4"],
    T_2w: Float[Tensor, "*#batch 4 4"],
    distances: Float[Tensor, "*#batch"],
) -> Float[Tensor, "*#batch 1"]:
    """Logarithm of the distance between two camera centers over the measured one; the centers must differ."""
    between = se3_inverse(T_2w)[..., :3, 3] - se3_inverse(T_1w)[..., :3, 3]
    return (torch.linalg.vector_norm(between, dim=-1) / distances).log()[..., None]


@full_precision
def displacement_error(
    T_1w: Float[Tensor, "*#batch 4 4"],
    T_2w: Float[Tensor, "*#batch 4 4"],
    measured: Float[Tensor, "*#batch 2 3"],
) -> Float[Tensor, "*#batch 3"]:
    """Difference between the displacement of an antenna and the measured one.

    `measured` is the displacement in the world, then the position of the antenna in the camera, its lever arm.
    """
    displacement_w, lever_c = measured.unbind(-2)
    first, second = (
        T_wc[..., :3, 3] + (T_wc[..., :3, :3] @ lever_c[..., None]).squeeze(-1)
        for T_wc in (se3_inverse(T_1w), se3_inverse(T_2w))
    )
    return second - first - displacement_w


@full_precision
def pose_error(
    T_cw: Float[Tensor, "*#batch 4 4"], prior: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*#batch 6"]:
    """Translation and rotation vector of T_cw @ prior^-1, as of `PosePrior`."""
    E = T_cw @ se3_inverse(prior)
    return torch.cat((E[..., :3, 3], so3_log(E[..., :3, :3])), dim=-1)


@full_precision
def direction_error(
    T_cw: Float[Tensor, "*#batch 4 4"], measured: Float[Tensor, "*#batch 2 3"]
) -> Float[Tensor, "*#batch 3"]:
    """Difference between a direction of the world in the camera and the measured one, radians where it is small.

    `measured` is the direction in the world, as that of gravity, then in the camera, both of unit length.
    """
    direction_w, direction_c = measured.unbind(-2)
    return (T_cw[..., :3, :3] @ direction_w[..., None]).squeeze(-1) - direction_c


@full_precision
def plane_error(
    points_w: Float[Tensor, "*#batch 3"], plane: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*#batch 1"]:
    """Distance of a point from a plane: normal of unit length, then n . x on the plane."""
    return ((points_w * plane[..., :3]).sum(-1) - plane[..., 3])[..., None]


@full_precision
def center_error(
    T_cw: Float[Tensor, "*#batch 4 4"], plane: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*#batch 1"]:
    """Distance of the camera center from a plane, as of `plane_error`: the difference of a height, for instance."""
    return plane_error(se3_inverse(T_cw)[..., :3, 3], plane)


@full_precision
def log_length_error(
    first_w: Float[Tensor, "*#batch 3"],
    second_w: Float[Tensor, "*#batch 3"],
    lengths: Float[Tensor, "*#batch"],
) -> Float[Tensor, "*#batch 1"]:
    """Logarithm of the distance between two points over the measured one; the points must differ."""
    return (torch.linalg.vector_norm(second_w - first_w, dim=-1) / lengths).log()[..., None]


@full_precision
def bounds_error(
    values: Float[Tensor, "*#batch D"], bounds: Float[Tensor, "*#batch 2 D"]
) -> Float[Tensor, "*#batch D"]:
    """How far values lie below the lower bounds (negative) or above the upper ones; zero within."""
    low, high = bounds.unbind(-2)
    return (values - high).clamp_min(0) + (values - low).clamp_max(0)


@dataclass(frozen=True)
class Factors:
    """F errors of one kind of some frames, some points, or the camera; differentiable with respect to what is measured,
    information, and what `error` closes over, such as the parameters of a network.

    Attributes:
        frames: rows of T_cw: one, two or more frames of each error, in any order; none where it is of points or the
            camera. A batch shares them.
        measured: what `error` takes as its last argument, leading with F.
        information: inverse covariances of the errors, symmetric; one of zero does not count. It leads with B
            where `measured` does.
        error: function of poses, world to camera, points and measured, to (..., F, D): error(T_1w, T_2w, measured) of
            two frames. PyTorch must be able to differentiate it in forward mode and twice.
        points: rows of points_w. Errors that join a point with anything else are meant for some tens of them: they
            are eliminated together.
        of_camera: the error is error(params, measured), with F = 1, of the one camera.
    """

    frames: Int[Tensor, "F n"]
    measured: Float[Tensor, "..."]
    information: Float[Tensor, "*#batch F D D"]
    error: Error
    points: Int[Tensor, "F m"] | None = None
    of_camera: bool = False

    @property
    def is_of_world(self) -> bool:
        """Whether the errors are of one frame or one point, and so relative to the world."""
        return self.frames.shape[1] + (0 if self.points is None else self.points.shape[1]) == 1

    @classmethod
    def poses(
        cls,
        frames: Int[Tensor, " F"],
        T_cw: Float[Tensor, "*batch F 4 4"],
        information: Float[Tensor, "*batch F 6 6"],
    ) -> Factors:
        """Priors of poses; see `pose_error`."""
        return cls(frames[:, None], T_cw, information, pose_error)

    @classmethod
    def heights(
        cls,
        frames: Int[Tensor, " F"],
        heights: Float[Tensor, "*batch F"],
        information: Float[Tensor, "*batch F"],
        up_w: Float[Tensor, " 3"],
    ) -> Factors:
        """Measured heights of camera centers along a direction of the world, in the unit of the points, which
        determine the scale unless all are the same; information: inverse variances."""
        measured = torch.cat((up_w.expand(*heights.shape, 3), heights[..., None]), dim=-1)
        return cls(frames[:, None], measured, information[..., None, None], center_error)

    @classmethod
    def directions(
        cls,
        frames: Int[Tensor, " F"],
        directions_c: Float[Tensor, "*batch F 3"],
        direction_w: Float[Tensor, " 3"],
        information: Float[Tensor, "*batch F"],
    ) -> Factors:
        """A direction of the world, such as that of gravity, as measured in the camera; both are of unit length.
        information: inverse variances, rad^-2."""
        measured = torch.stack((direction_w.expand_as(directions_c), directions_c), dim=-2)
        eye = torch.eye(3, dtype=measured.dtype, device=measured.device)
        return cls(frames[:, None], measured, information[..., None, None] * eye, direction_error)

    @classmethod
    def planes(
        cls,
        points: Int[Tensor, " F"],
        planes_w: Float[Tensor, "*batch F 4"],
        information: Float[Tensor, "*batch F"],
    ) -> Factors:
        """Points that lie on planes of the world, as `plane_error` has them; information: inverse variances of their
        distances."""
        return cls(_no_frames(points), planes_w, information[..., None, None], plane_error, points[:, None])

    @classmethod
    def lengths(
        cls,
        points: Int[Tensor, "F 2"],
        lengths: Float[Tensor, "*batch F"],
        information: Float[Tensor, "*batch F"],
    ) -> Factors:
        """Known distances between two points, which determine the scale; information: inverse variances of the
        logarithm, that is of the relative error."""
        return cls(_no_frames(points), lengths, information[..., None, None], log_length_error, points)

    @classmethod
    def camera_bounds(
        cls, low: Float[Tensor, " P"], high: Float[Tensor, " P"], information: Float[Tensor, " P"]
    ) -> Factors:
        """Soft bounds on the parameters of a free camera, infinite where there are none; see `bounds_error`.
        information: inverse variances of what is allowed beyond the bounds."""
        measured = torch.stack((low, high))[None]
        none = torch.zeros(1, 0, dtype=torch.int64, device=low.device)
        return cls(none, measured, information.diag()[None], bounds_error, of_camera=True)

    @classmethod
    def relative_poses(
        cls,
        frames: Int[Tensor, "F 2"],
        T_21: Float[Tensor, "*batch F 4 4"],
        information: Float[Tensor, "*batch F 6 6"],
    ) -> Factors:
        """Measured motions from the first to the second frame, as of odometry; see `relative_pose_error`."""
        return cls(frames, T_21, information, relative_pose_error)

    @classmethod
    def distances(
        cls,
        frames: Int[Tensor, "F 2"],
        distances: Float[Tensor, "*batch F"],
        information: Float[Tensor, "*batch F"],
    ) -> Factors:
        """Measured distances between camera centers, in the unit of the points, which determine the scale; information:
        inverse variances of the logarithm, that is of the relative error."""
        return cls(frames, distances, information[..., None, None], log_distance_error)

    @classmethod
    def displacements(
        cls,
        frames: Int[Tensor, "F 2"],
        displacements_w: Float[Tensor, "*batch F 3"],
        information: Float[Tensor, "*batch F 3 3"],
        lever_c: Float[Tensor, " 3"] | None = None,
    ) -> Factors:
        """Measured displacements of an antenna, as between positions of a receiver, whose constant offset they are
        free of; see `displacement_error`.

        Args:
            frames: pairs.
            displacements_w: along the axes of the world, in the unit of the points; information: inverse covariances.
            lever_c: position of the antenna in the camera, in the unit of the points; None: at its center.
        """
        lever = torch.zeros_like(displacements_w[..., 0, :]) if lever_c is None else lever_c
        measured = torch.stack((displacements_w, lever[..., None, :].expand_as(displacements_w)), dim=-2)
        return cls(frames, measured, information, displacement_error)


@dataclass(frozen=True)
class DepthPrior:
    """Measured depths of the observed points, such as those of a network; they determine the scale.

    Attributes:
        depths: z in the camera, in the unit of the points.
        information: inverse variances of the relative error of the depth (of its logarithm); zero without a depth.
    """

    depths: Float[Tensor, "*#batch O"]
    information: Float[Tensor, "*#batch O"]


def _no_frames(points: Tensor) -> Tensor:
    """(F, 0) rows."""
    return points.new_zeros(len(points), 0)


class FactorKind(NamedTuple):
    """The discrete part of `Factors`: rows of frames (F, n) and of points (F, m), whether they are of the camera, the
    shape of one measurement, D, and the error."""

    frames: Tensor
    points: Tensor
    of_camera: bool
    shape: tuple[int, ...]
    size: int
    error: Error

    @property
    def pairs(self) -> Tensor:
        """The pairs (M, 2) of frames that errors join."""
        number = torch.combinations(torch.arange(self.frames.shape[1], device=self.frames.device))
        return self.frames[:, number].flatten(0, 1)


class FrameBlocks(NamedTuple):
    """Blocks (..., F, 6, 6) of a Hessian between frames first (F,) and second (F,)."""

    first: Tensor
    second: Tensor
    blocks: Tensor


class PointBlocks(NamedTuple):
    """What factors of points add to a Hessian: over points (N, 3) and (N, 3, 3), and beside the diagonal, where they
    join points with points or frames, a symmetric matrix (r, r).

    joined: of each of its rows the place among all numbers of frames, 6 K, and then of points, 3 N
    """

    gradient: Tensor
    diagonal: Tensor
    joined: Tensor
    matrix: Tensor


class LinearErrors(NamedTuple):
    """Errors (F, D) of one kind, their derivatives (F, D, 6 n + 3 m) or (1, D, C), and their information."""

    kind: FactorKind
    error: Tensor
    J: Tensor
    information: Tensor


def factor_kinds(factors: Sequence[Factors]) -> list[FactorKind]:
    """The discrete parts of factors that `packed_factors` has accepted."""
    return [
        FactorKind(
            each.frames,
            _no_frames(each.frames) if each.points is None else each.points,
            each.of_camera,
            tuple(each.measured.shape[each.information.ndim - 2 :]),
            each.information.shape[-1],
            each.error,
        )
        for each in factors
    ]


def packed_factors(
    factors: Sequence[Factors], T_cw: Float[Tensor, "B K 4 4"], num_points: int
) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B L"]]:
    """All that is measured and all information, flat, one kind after the other.

    Raises ValueError where a shape or an index does not fit.
    """
    batch, num_frames = T_cw.shape[:2]
    measured, information = [T_cw.new_zeros(batch, 0)], [T_cw.new_zeros(batch, 0)]
    for each in factors:
        frames, matrices, own = each.frames, each.information, each.measured
        points = _no_frames(frames) if each.points is None else each.points
        for name, rows, most in (("frames", frames, num_frames), ("points", points, num_points)):
            if rows.ndim != 2 or len(rows) != len(frames):
                raise ValueError(f"{name} of factors must be (F, n), not {tuple(rows.shape)}")
            if rows.numel() and not 0 <= int(rows.min()) <= int(rows.max()) < most:
                raise ValueError(f"{name} of factors must lie in 0 ... {most - 1}")
            ordered = rows.sort(dim=1).values
            if (ordered[:, 1:] == ordered[:, :-1]).any():
                raise ValueError(f"a factor must join different {name}, not one with itself")
        count, size = len(frames), matrices.shape[-1]
        if each.of_camera == bool(frames.shape[1] + points.shape[1]) or (each.of_camera and count != 1):
            raise ValueError("a factor must be of frames and points, or one of the camera alone")
        lead = (batch,) if matrices.ndim == 4 else ()
        if matrices.shape != (*lead, count, size, size) or own.shape[: len(lead) + 1] != (*lead, count):
            raise ValueError(
                f"information of factors must be (F, D, D), and what they measure must lead with F = {count}, not be "
                f"{tuple(matrices.shape)} and {tuple(own.shape)}"
            )
        shape = tuple(own.shape[len(lead) + 1 :])
        measured.append(own.expand(batch, count, *shape).reshape(batch, -1))
        information.append(matrices.expand(batch, count, size, size).reshape(batch, -1))
    return torch.cat(measured, dim=1), torch.cat(information, dim=1)


def tensors_of_errors(
    factors: Sequence[Factors],
    T_cw: Float[Tensor, "B K 4 4"],
    points_w: Float[Tensor, "B N 3"],
    params: Float[Tensor, "B C P"],
) -> list[Tensor]:
    """The tensors with derivatives that the errors close over, such as the parameters of a network."""
    found: dict[int, Tensor] = {}
    for each, kind in zip(factors, factor_kinds(factors), strict=True):
        if len(each.frames):
            own = each.measured if each.information.ndim == 3 else each.measured[0]
            _, tensors = tensors_closed_over(
                each.error, *_seen_by(kind, T_cw[0], points_w[0], params[0]), own
            )
            found |= {id(tensor): tensor for tensor in tensors}
    return list(found.values())


def _unpacked(
    kinds: Sequence[FactorKind], measured: Float[Tensor, "*batch M"], information: Float[Tensor, "*batch L"]
) -> list[tuple[FactorKind, Tensor, Tensor]]:
    """Each kind with its measured (..., F, ...) and its information (..., F, D, D)."""
    parts = measured.split([len(kind.frames) * prod(kind.shape) for kind in kinds], dim=-1)
    matrices = information.split([len(kind.frames) * kind.size**2 for kind in kinds], dim=-1)
    return [
        (
            kind,
            part.unflatten(-1, (len(kind.frames), *kind.shape)),
            matrix.unflatten(-1, (len(kind.frames), kind.size, kind.size)),
        )
        for kind, part, matrix in zip(kinds, parts, matrices, strict=True)
    ]


def frames_with_factors(
    kinds: Sequence[FactorKind], information: Float[Tensor, "B L"], num_frames: int
) -> Tensor:
    """Which frames (B, K) have a factor that counts."""
    touched = torch.zeros(len(information), num_frames, dtype=torch.int64, device=information.device)
    matrices = information.split([len(kind.frames) * kind.size**2 for kind in kinds], dim=-1) if kinds else ()
    for kind, own in zip(kinds, matrices, strict=True):
        counts = (own.unflatten(-1, (len(kind.frames), kind.size**2)) != 0).any(-1).long()
        for frames in kind.frames.unbind(1):
            touched = touched.index_add(1, frames, counts)
    return touched > 0


class FactorTerms(NamedTuple):
    """Cost (), and gradients and Hessians of factors over K frames, which move along the axes of the world, over the n
    free directions of the camera, (n,) and (n, n), and over points; `points` is None where no factor has any."""

    cost: Tensor
    frames_gradient: Tensor
    frames: Tensor
    between: FrameBlocks
    camera_gradient: Tensor
    camera: Tensor
    points: PointBlocks | None
    errors: tuple[LinearErrors, ...]


def factor_terms(
    kinds: Sequence[FactorKind],
    at: tuple[Float[Tensor, "K 4 4"], Float[Tensor, "N 3"], Float[Tensor, "C P"]],
    measured: Float[Tensor, " M"],
    information: Float[Tensor, " L"],
    directions: Float[Tensor, "P n"],
    curvature: Literal["none", "definite", "exact"],
) -> FactorTerms:
    """The terms at poses, points and camera parameters, which move along directions.

    curvature: that of the errors themselves: of "none" (Gauss and Newton), of those parts that leave the Hessian of an
    error positive semi-definite, or of all
    """
    T_cw, points_w, _ = at
    count, num_points, most = len(T_cw), len(points_w), directions.shape[1]
    cost, gradient = T_cw.new_zeros(()), T_cw.new_zeros(6 * count + 3 * num_points)
    camera_gradient, camera = T_cw.new_zeros(most), T_cw.new_zeros(most, most)
    frames, points = T_cw.new_zeros(count, 6, 6), T_cw.new_zeros(num_points, 3, 3)
    pairs, blocks, joined = [kinds[0].frames.new_zeros(0, 2)], [T_cw.new_zeros(0, 6, 6)], []
    errors = []
    for kind, own, matrix in _unpacked(kinds, measured, information):
        moved = moved_errors(kind, at, own, directions, in_world=True)
        n, m = kind.frames.shape[1], kind.points.shape[1]
        zero = T_cw.new_zeros(len(kind.frames), most if kind.of_camera else 6 * n + 3 * m)
        size = kind.size
        if curvature == "none":
            error, J = _with_jacobian(moved, zero, size)
        else:
            both, of_both = _with_jacobian(partial(_with_slope, moved, matrix), zero, size + zero.shape[1])
            error, J, hessian = both[:, :size], of_both[:, :size], of_both[:, size:]
        errors.append(LinearErrors(kind, error, J, matrix))
        pulled = J.mT @ matrix
        slope = (pulled @ error[..., None]).squeeze(-1)
        if curvature == "none":
            hessian = pulled @ J
        if curvature == "definite":
            values, vectors = torch.linalg.eigh(hessian)
            hessian = (vectors * values.clamp_min(0)[..., None, :]) @ vectors.mT
        cost = cost + _cost(error, matrix)
        if kind.of_camera:
            camera_gradient, camera = camera_gradient + slope[0], camera + hessian[0]
            continue
        numbers = 6 * kind.frames[..., None] + torch.arange(6, device=zero.device)
        of_points = 6 * count + 3 * kind.points[..., None] + torch.arange(3, device=zero.device)
        numbers = torch.cat((numbers.flatten(1), of_points.flatten(1)), dim=1)
        gradient = gradient.index_add(0, numbers.flatten(), slope.flatten())
        for i in range(n):
            rows = slice(6 * i, 6 * i + 6)
            frames = frames.index_add(0, kind.frames[:, i], hessian[:, rows, rows])
            for j in range(i + 1, n):
                pairs.append(kind.frames[:, [i, j]])
                blocks.append(hessian[:, rows, 6 * j : 6 * j + 6])
        for i in range(m):
            rows = slice(6 * n + 3 * i, 6 * n + 3 * i + 3)
            points = points.index_add(0, kind.points[:, i], hessian[:, rows, rows])
        if m and n + m > 1:
            beside = torch.ones_like(hessian[0])
            beside[: 6 * n, : 6 * n] = 0
            for i in range(m):
                rows = slice(6 * n + 3 * i, 6 * n + 3 * i + 3)
                beside[rows, rows] = 0
            joined.append((numbers, beside * hessian))
    ends = torch.cat(pairs)
    between = FrameBlocks(ends[:, 0], ends[:, 1], torch.cat(blocks))
    split = 6 * count
    joining: PointBlocks | None = None
    if any(kind.points.shape[1] for kind in kinds):
        joining = PointBlocks(gradient[split:].view(-1, 3), points, *_beside(joined, gradient))
    of_frames = gradient[:split].view(-1, 6), frames, between
    return FactorTerms(cost, *of_frames, camera_gradient, camera, joining, tuple(errors))


def errors_along(
    errors: Sequence[LinearErrors], of_frames: Float[Tensor, "K 6 g"], of_points: Float[Tensor, "N 3 g"]
) -> tuple[Float[Tensor, " g"], Float[Tensor, "g g"]]:
    """The gradient and the Gauss-Newton Hessian of the cost of errors along g motions of the world, along the axes of
    which frames and points move; exactly zero along those that change nothing, where rounding would leave a slope."""
    motions = of_frames.shape[-1]
    gradient, hessian = of_frames.new_zeros(motions), of_frames.new_zeros(motions, motions)
    for kind, error, J, information in errors:
        if not kind.of_camera:
            parts = of_frames[kind.frames].flatten(1, 2), of_points[kind.points].flatten(1, 2)
            moved = torch.cat(parts, dim=1)
            along, sizes = J @ moved, J.norm(dim=2, keepdim=True) * moved.norm(dim=1, keepdim=True)
            along = torch.where(along.abs() > ROUNDINGS * torch.finfo(J.dtype).eps * sizes, along, 0.0)
            pulled = (information @ along).flatten(0, 1)
            gradient, hessian = (
                gradient + pulled.mT @ error.flatten(),
                hessian + pulled.mT @ along.flatten(0, 1),
            )
    return gradient, hessian


def scale_step(gradient: Float[Tensor, " g"], hessian: Float[Tensor, "g g"]) -> float:
    """The share by which errors with these derivatives ask for a smaller scale, the first of g motions of the world, by
    a step of Gauss and Newton in all of them; zero where they do not depend on it."""
    size = hessian.diagonal().clamp_min(0).sqrt()
    size = torch.where(size > 0, size, 1.0)
    inverse = torch.linalg.pinv(hessian / (size[:, None] * size), rtol=1e-9, hermitian=True)
    return float(inverse[0] @ (gradient / size) / size[0])


def _beside(joined: list[tuple[Tensor, Tensor]], like: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct numbers (r,) of joined frames and points, and the sum (r, r) of their blocks."""
    every = [numbers.flatten() for numbers, _ in joined]
    distinct = torch.unique(torch.cat([torch.zeros(0, dtype=torch.int64, device=like.device), *every]))
    matrix = like.new_zeros(len(distinct), len(distinct))
    for numbers, blocks in joined:
        rows = torch.searchsorted(distinct, numbers)
        matrix = matrix.index_put((rows[:, :, None], rows[:, None, :]), blocks, accumulate=True)
    return distinct, matrix


def factor_slope(
    kinds: Sequence[FactorKind],
    at: tuple[Float[Tensor, "B K 4 4"], Float[Tensor, "B N 3"], Float[Tensor, "B C P"]],
    measured: Float[Tensor, "B M"],
    information: Float[Tensor, "B L"],
    step: tuple[Float[Tensor, "B K 6"], Float[Tensor, "B N 3"], Float[Tensor, "B C P"]],
) -> Float[Tensor, ""]:
    """The derivative of the cost of all factors along steps of the frames, the points and the camera's parameters."""
    slope = at[0].new_zeros(())
    for kind, own, matrix in _unpacked(kinds, measured, information):
        along = torch.cat([part.flatten(-2) for part in _rows_of(kind, *step[:2])], dim=-1)
        along = step[2] if kind.of_camera else along
        moved = moved_errors(kind, at, own)
        # That of the cost, by a reverse pass: forward mode takes three times as long.
        error, pull = _pullback(moved, torch.zeros_like(along))
        slope = slope + (pull((matrix @ error[..., None]).squeeze(-1)) * along).sum()
    return slope


def _rows_of(kind: FactorKind, of_frames: Tensor, of_points: Tensor) -> tuple[Tensor, Tensor]:
    """(..., F, n, 6) and (..., F, m, 3) of the frames and points of the errors."""
    return of_frames[..., kind.frames, :], of_points[..., kind.points, :]


def _seen_by(kind: FactorKind, T_cw: Tensor, points_w: Tensor, params: Tensor) -> tuple[Tensor, ...]:
    """The poses (..., F, 4, 4) and points (..., F, 3) that an error takes, or the camera (..., 1, P)."""
    if kind.of_camera:
        return (params,)
    frames, points = kind.frames.unbind(1), kind.points.unbind(1)
    return *(T_cw[..., rows, :, :] for rows in frames), *(points_w[..., rows, :] for rows in points)


def moved_errors(
    kind: FactorKind,
    at: tuple[Tensor, Tensor, Tensor],
    measured: Tensor,
    directions: Tensor | None = None,
    in_world: bool = False,
) -> Callable[[Tensor], Tensor]:
    """The errors as a function of steps of what they are of, one after the other; directions: in which the camera
    moves, of all its parameters if None; in_world: whether steps of frames are along the axes of the world."""
    return partial(_errors_at, kind, (measured, *_seen_by(kind, *at)), directions, in_world)


def _errors_at(
    kind: FactorKind, of_rows: tuple[Tensor, ...], directions: Tensor | None, in_world: bool, step: Tensor
) -> Tensor:
    """The errors (..., F, D) of `moved_errors` after a step, which may lead with copies."""
    n, lead = kind.frames.shape[1], step.shape[: step.ndim - 1 - of_rows[0].ndim + len(kind.shape)]
    measured, *seen = (each.expand(*lead, *each.shape) for each in of_rows)
    if kind.of_camera:
        return kind.error(seen[0] + (step if directions is None else step @ directions.mT), measured)
    frames, points = step[..., : 6 * n].unflatten(-1, (n, 6)), step[..., 6 * n :]
    values = []
    for number, value in enumerate(seen):
        if number >= n:
            values.append(value + points[..., 3 * (number - n) : 3 * (number - n) + 3])
            continue
        xi = frames[..., number, :]
        values.append(retract(value, rotated(value[..., :3, :3], xi[..., None])[..., 0] if in_world else xi))
    return kind.error(*values, measured)


def _with_jacobian(function: Callable[[Tensor], Tensor], zero: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The value (F, D) at zero (F, n) and the derivatives (F, D, n) of its rows, D = size.

    Each component is differentiated in a copy of its own, so that one reverse pass is enough for all of them.
    """
    copies = min(max(_AT_ONCE // max(len(zero), 1), 1), max(size, 1))
    value, pull = _pullback(function, zero.expand(copies, *zero.shape))
    rows = []
    for columns in torch.eye(size, dtype=zero.dtype, device=zero.device).split(copies):
        of_copies = torch.nn.functional.pad(columns, (0, 0, 0, copies - len(columns)))
        rows.append(pull(of_copies[:, None].expand_as(value))[: len(columns)])
    return value[0], torch.cat(rows).movedim(0, -2)


def _pullback(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """The value of a function and its vector-Jacobian product."""
    if in_transform():
        value, pull, *_ = vjp(function, at)
        return value, lambda vector: pull(vector)[0]
    keep = torch.is_grad_enabled()
    with torch.enable_grad():
        at = at.detach().requires_grad_()
        value = function(at)
        value = value if value.requires_grad else value + 0 * at.sum()
    options = {"retain_graph": True, "create_graph": keep, "materialize_grads": True}
    return value if keep else value.detach(), lambda vector: torch.autograd.grad(
        value, at, vector, **options
    )[0]


def _with_slope(moved: Callable[[Tensor], Tensor], information: Tensor, step: Tensor) -> Tensor:
    """Errors (..., F, D) and the gradient (..., F, n) of their cost in a step, side by side."""
    if in_transform():
        slope, error = grad(partial(_cost_and_error, moved, information), has_aux=True)(step)
    else:
        cost, error = _cost_and_error(moved, information, step)
        (slope,) = torch.autograd.grad(cost, step, create_graph=True, materialize_grads=True)
    return torch.cat((error, slope), dim=-1)


def _cost_and_error(
    moved: Callable[[Tensor], Tensor], information: Tensor, step: Tensor
) -> tuple[Tensor, Tensor]:
    error = moved(step)
    return _cost(error, information), error


def _cost(error: Tensor, information: Tensor) -> Tensor:
    return 0.5 * torch.einsum("...i,...ij,...j->...", error, information, error).sum()


class DepthTerms(NamedTuple):
    """Costs (O,) of depths and their first and second derivatives in z."""

    cost: Tensor
    slope: Tensor
    curvature: Tensor


def depth_terms(
    depths: Float[Tensor, " O"], information: Float[Tensor, " O"], z: Float[Tensor, " O"], exact: bool
) -> DepthTerms:
    """The terms of half of information times log(z / depth)^2; zero behind the camera. exact: not of Gauss-Newton."""
    counted = (information > 0) & (z.detach() > torch.finfo(z.dtype).eps)
    weight, z = torch.where(counted, information, 0.0), torch.where(counted, z, 1.0)
    error = (z / torch.where(counted, depths, 1.0)).log()
    curvature = weight * (1 - error) if exact else weight
    return DepthTerms(0.5 * weight * error.square(), weight * error / z, curvature / z.square())


def with_depths(expansion: Expansion, terms: DepthTerms, rows: Float[Tensor, "3 O"]) -> Expansion:
    """An expansion (3 + P, O), (3 + P, 3 + P, O) with depths whose derivatives in the points are `rows`."""
    more = expansion.gradient.shape[0] - 3
    gradient = torch.nn.functional.pad(terms.slope * rows, (0, 0, 0, more))
    hessian = (terms.curvature * rows)[:, None] * rows
    hessian = torch.nn.functional.pad(hessian, (0, 0, 0, more, 0, more))
    return Expansion(expansion.gradient + gradient, expansion.hessian + hessian)
