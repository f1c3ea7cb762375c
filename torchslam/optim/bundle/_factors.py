"""Additional factors: priors of the depth of observed points, and user-defined errors between two frames.

They cost half of e^T information e, as priors do, without a robust kernel. A depth adds one row to its observation. An
error between frames adds blocks to the reduced system, which the elimination of the points leaves as it is: neither
makes a bundle adjustment less sparse. Derivatives of errors between frames are those of autograd, of all at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.func import grad, jvp

from torchslam.geometry.lie import se3_inverse, so3_log
from torchslam.geometry.precision import full_precision
from torchslam.optim._core.implicit import tensors_closed_over
from torchslam.optim._core.residuals import Expansion
from torchslam.optim._core.tangent import retract, row_jacobian

FrameError = Callable[[Tensor, Tensor, Tensor], Tensor]
"""error(T_1w, T_2w, measured) -> (..., F, D), of poses (..., F, 4, 4), each row from its own rows alone."""


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


@dataclass(frozen=True)
class FrameFactors:
    """F errors of one kind between pairs of frames; differentiable with respect to what is measured and information.

    Attributes:
        frames: rows of T_cw, first and second frame of each pair; a batch shares them.
        measured: what `error` takes as its third argument, leading with F.
        information: inverse covariances of the errors, symmetric; a pair with zero does not count. It leads with B
            where `measured` does.
        error: function of poses, world to camera, and measured, to (..., F, D). PyTorch must be able to differentiate
            it in forward mode and twice.
    """

    frames: Int[Tensor, "F 2"]
    measured: Float[Tensor, "..."]
    information: Float[Tensor, "*#batch F D D"]
    error: FrameError

    @classmethod
    def relative_poses(
        cls,
        frames: Int[Tensor, "F 2"],
        T_21: Float[Tensor, "*batch F 4 4"],
        information: Float[Tensor, "*batch F 6 6"],
    ) -> FrameFactors:
        """Measured motions from the first to the second frame, as of odometry; see `relative_pose_error`."""
        return cls(frames, T_21, information, relative_pose_error)

    @classmethod
    def distances(
        cls,
        frames: Int[Tensor, "F 2"],
        distances: Float[Tensor, "*batch F"],
        information: Float[Tensor, "*batch F"],
    ) -> FrameFactors:
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
    ) -> FrameFactors:
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


class FactorKind(NamedTuple):
    """The discrete part of `FrameFactors`: rows (F, 2), the shape of one measurement, D, and the error."""

    frames: Tensor
    shape: tuple[int, ...]
    size: int
    error: FrameError


class FrameBlocks(NamedTuple):
    """Blocks (..., F, 6, 6) of a Hessian between frames first (F,) and second (F,)."""

    first: Tensor
    second: Tensor
    blocks: Tensor


def factor_kinds(factors: Sequence[FrameFactors]) -> list[FactorKind]:
    """The discrete parts of factors that `packed_factors` has accepted."""
    return [
        FactorKind(
            each.frames,
            tuple(each.measured.shape[each.information.ndim - 2 :]),
            each.information.shape[-1],
            each.error,
        )
        for each in factors
    ]


def packed_factors(
    factors: Sequence[FrameFactors], T_cw: Float[Tensor, "B K 4 4"]
) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B L"]]:
    """All that is measured and all information, flat, one kind after the other.

    Raises ValueError where a shape or an index does not fit.
    """
    batch, num_frames = T_cw.shape[:2]
    measured, information = [T_cw.new_zeros(batch, 0)], [T_cw.new_zeros(batch, 0)]
    for each in factors:
        frames, matrices, own = each.frames, each.information, each.measured
        if frames.ndim != 2 or frames.shape[1] != 2:
            raise ValueError(f"frames of factors must be (F, 2), not {tuple(frames.shape)}")
        if len(frames) and not 0 <= int(frames.min()) <= int(frames.max()) < num_frames:
            raise ValueError(f"frames of factors must lie in 0 ... {num_frames - 1}")
        if (frames[:, 0] == frames[:, 1]).any():
            raise ValueError("a factor must join two frames, not one with itself")
        count, size = len(frames), matrices.shape[-1]
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


def tensors_of_errors(factors: Sequence[FrameFactors], T_cw: Float[Tensor, "B K 4 4"]) -> list[Tensor]:
    """The tensors with derivatives that the errors close over, such as the parameters of a network."""
    found: dict[int, Tensor] = {}
    for each in factors:
        if len(each.frames):
            T_1w, T_2w = (T_cw[0, rows] for rows in each.frames.unbind(1))
            own = each.measured if each.information.ndim == 3 else each.measured[0]
            _, tensors = tensors_closed_over(each.error, T_1w, T_2w, own)
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


def factor_terms(
    kinds: Sequence[FactorKind],
    T_cw: Float[Tensor, "K 4 4"],
    measured: Float[Tensor, " M"],
    information: Float[Tensor, " L"],
    exact: bool,
) -> tuple[Tensor, Tensor, Tensor, FrameBlocks]:
    """Cost (), and gradient (K, 6) and Hessian over frames: blocks on the diagonal (K, 6, 6), and between pairs.

    exact: the exact Hessian, not that of Gauss and Newton.
    """
    cost, gradient = T_cw.new_zeros(()), T_cw.new_zeros(len(T_cw), 6)
    diagonal, pairs, blocks = T_cw.new_zeros(len(T_cw), 6, 6), [], []
    for kind, own, matrix in _unpacked(kinds, measured, information):
        first, second = kind.frames.unbind(1)
        T_1w, T_2w = T_cw[first], T_cw[second]
        moved = _moved(kind, T_1w, T_2w, own)
        zero = T_cw.new_zeros(len(first), 12)
        error, J = moved(zero), row_jacobian(moved, zero)
        pulled = J.mT @ matrix
        slope = (pulled @ error[..., None]).squeeze(-1)
        hessian = row_jacobian(grad(partial(_cost_at, moved, matrix)), zero) if exact else pulled @ J
        cost = cost + _cost(error, matrix)
        gradient = gradient.index_add(0, first, slope[:, :6]).index_add(0, second, slope[:, 6:])
        diagonal = diagonal.index_add(0, first, hessian[:, :6, :6])
        diagonal = diagonal.index_add(0, second, hessian[:, 6:, 6:])
        pairs.append(kind.frames)
        blocks.append(hessian[:, :6, 6:])
    ends = torch.cat(pairs)
    return cost, gradient, diagonal, FrameBlocks(ends[:, 0], ends[:, 1], torch.cat(blocks))


def factor_slope(
    kinds: Sequence[FactorKind],
    T_cw: Float[Tensor, "B K 4 4"],
    measured: Float[Tensor, "B M"],
    information: Float[Tensor, "B L"],
    xi: Float[Tensor, "B K 6"],
) -> Float[Tensor, ""]:
    """The derivative of the cost of all factors along steps of the frames."""
    slope = T_cw.new_zeros(())
    for kind, own, matrix in _unpacked(kinds, measured, information):
        first, second = kind.frames.unbind(1)
        step = torch.cat((xi[:, first], xi[:, second]), dim=-1)
        moved = _moved(kind, T_cw[:, first], T_cw[:, second], own)
        error, velocity = jvp(moved, (torch.zeros_like(step),), (step,))[:2]
        slope = slope + torch.einsum("...i,...ij,...j->...", error, matrix, velocity).sum()
    return slope


def _moved(kind: FactorKind, T_1w: Tensor, T_2w: Tensor, measured: Tensor) -> Callable[[Tensor], Tensor]:
    """The errors as a function of steps (..., F, 12) of both poses."""

    def at(step: Tensor) -> Tensor:
        return kind.error(retract(T_1w, step[..., :6]), retract(T_2w, step[..., 6:]), measured)

    return at


def _cost_at(moved: Callable[[Tensor], Tensor], information: Tensor, step: Tensor) -> Tensor:
    return _cost(moved(step), information)


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
