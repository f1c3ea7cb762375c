"""Normal equations of many small bundle adjustments at once, every frame of one against every point of it.

What the sparse equations of `schur` gather and scatter is dense here, with the points along the last dimension: every
operation streams through contiguous memory, sums over frames and points are batched matrix products, and the Schur
complement is one product per problem. For windows of a few frames that see most of the same points.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.optim.bundle.priors import block_diagonal
from torchslam.optim.core.linear import DefiniteFactor, factorize, inverse_root_3x3

# eps_ijk of the cross product: (a x b)_i = eps_ijk a_j b_k.
_AXES = torch.eye(3, dtype=torch.float64)
_CROSS = torch.linalg.cross(_AXES[:, None].expand(3, 3, 3), _AXES.expand(3, 3, 3))


class GridExpansion(NamedTuple):
    """`residuals.Expansion` of every frame and point: gradient (B, F, D, P), hessian (B, F, D, D, P), D = 3 + K."""

    gradient: Tensor
    hessian: Tensor


class GridEquations(NamedTuple):
    """Gradient and Hessian over F free frames, which move along the axes of the world as in `assembly`, and the
    cameras, D = 6 F + K, and points.

    gradient: (B, D), points_gradient: (B, 3, P), reduced: (B, D, D), points: (B, 3, 3, P), coupling: (B, D, 3, P)
    """

    gradient: Tensor
    points_gradient: Tensor
    reduced: Tensor
    points: Tensor
    coupling: Tensor


def assemble_grid(
    expansion: GridExpansion, rays_w: Tensor, R_cw: Tensor, free: Tensor, exact: bool
) -> GridEquations:
    """Normal equations over the first frames, of which those that are free (B, F') move, all points, and the cameras.

    expansion: in the points in the camera frames
    rays_w:    (B, F, 3, P) from the cameras to the points, in the axes of the world; R_cw: (B, F, 3, 3)
    exact:     include the second-order terms of the rotation
    """
    dims, leading, R_wc = expansion.gradient.shape[2], free.shape[1], R_cw.mT
    upper = expansion.hessian[:, :, :3]
    curve = _times(R_wc, R_wc[:, :, None] @ upper[:, :, :, :3])  # (B, F, 3, 3, P): R^T C R
    slope, across = R_wc @ expansion.gradient[:, :, :3], _times(R_wc, upper[:, :, :, 3:])
    points, points_gradient, points_camera = curve.sum(1), slope.sum(1), across.sum(1)

    slope, curve, across, rays_w = (part[:, :leading] for part in (slope, curve, across, rays_w))
    coupling = torch.stack((*curve.unbind(2), *_cross(rays_w[..., None, :], curve)), dim=2)
    sums = _sum_by_frame(slope, across, coupling, rays_w, exact)
    if exact:
        eye = torch.eye(3, dtype=slope.dtype, device=slope.device)[None, None, ..., None]
        bend = torch.stack(_cross(slope[:, :, :, None], eye), dim=2)
        coupling = coupling - torch.nn.functional.pad(bend, (0, 0, 0, 0, 3, 0))
    gradient, frames, frames_camera = sums
    if not free.all():  # what only fills up stays where it is
        gradient = torch.where(free[..., None], gradient, 0.0)
        eye = torch.eye(6, dtype=frames.dtype, device=frames.device)
        frames = torch.where(free[..., None, None], frames, eye)
        frames_camera = torch.where(free[..., None, None], frames_camera, 0.0)
        coupling = torch.where(free[..., None, None, None], coupling, 0.0)
    coupling, reduced = coupling.flatten(1, 2), block_diagonal(frames)
    if dims > 3:
        frames_camera = frames_camera.flatten(1, 2)
        camera = expansion.hessian[:, :, 3:, 3:].sum((1, -1))
        coupling = torch.cat((coupling, points_camera.transpose(1, 2)), dim=1)
        reduced = torch.cat(
            (
                torch.cat((reduced, frames_camera), dim=-1),
                torch.cat((frames_camera.mT, camera), dim=-1),
            ),
            dim=1,
        )
    gradient = torch.cat((gradient.flatten(1), expansion.gradient[:, :, 3:].sum((1, -1))), dim=-1)
    return GridEquations(gradient, points_gradient, reduced, points, coupling)


def _times(R: Tensor, columns: Tensor) -> Tensor:
    """R (B, F, 3, 3) times columns (B, F, 3, n, P)."""
    return (R @ columns.flatten(3)).view_as(columns)


def _cross(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """a x b along dimension 2."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(2), b.unbind(2)
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


def _sum_by_frame(
    slope: Tensor, across: Tensor, coupling: Tensor, rays_w: Tensor, exact: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """G^T q (B, F, 6), G^T C G (B, F, 6, 6) and G^T C_camera (B, F, 6, K) summed over the points, G = [I, -r^].

    They are sums of q, C_camera and G^T C (B, F, 6, 3, P) times 1 and r.
    """
    num_camera, cross = across.shape[3], _CROSS.to(rays_w.dtype).to(rays_w.device)
    affine = torch.cat((torch.ones_like(rays_w[:, :, :1]), rays_w), dim=2).mT
    pushed = slope @ affine  # (B, F, 3, 4)
    outer = pushed[..., 1:]
    torque = torch.einsum("bmj,xfjm->xfb", cross, outer)
    moments = (coupling.flatten(2, 3) @ affine).unflatten(2, (6, 3))  # (B, F, 6, 3, 4)
    frames = torch.cat((moments[..., 0], torch.einsum("clk,xfakl->xfac", cross, moments[..., 1:])), dim=-1)
    if exact:
        eye = torch.eye(3, dtype=outer.dtype, device=outer.device)
        trace = outer.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        bend = 0.5 * (outer + outer.mT) - trace * eye
        frames = frames + torch.nn.functional.pad(bend, (3, 0, 3, 0))
    sums = (across.flatten(2, 3) @ affine).unflatten(2, (3, num_camera))  # (B, F, 3, K, 4)
    turned = torch.einsum("bmj,xfjkm->xfbk", cross, sums[..., 1:])
    return torch.cat((pushed[..., 0], torque), dim=-1), frames, torch.cat((sums[..., 0], turned), dim=-2)


class FactorizedGrid(NamedTuple):
    """Equations ready to be solved for any right side: the inverse roots (B, 3, 3, P) of the points' blocks, zero for
    points that do not move, the coupling times them (B, D, 3 P), and what is left for frames and cameras."""

    root: Tensor
    whitened: Tensor
    reduced: DefiniteFactor

    def solve(self, right: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """H^-1 right, (B, D) and (B, 3, P); all zero where the reduced system is not definite."""
        halves = (self.root * points[:, None]).sum(2)
        rest = right - (self.whitened @ halves.flatten(1)[..., None]).squeeze(-1)
        solution = self.reduced.solve(rest[..., None])
        halves = halves - (self.whitened.mT @ solution).view_as(halves)
        moved = (self.root * halves[:, :, None]).sum(1)
        return solution.squeeze(-1), torch.where(self.reduced.definite[:, None, None], moved, 0.0)

    def marginals(self) -> tuple[Tensor, Tensor]:
        """The inverse over frames and cameras (B, D, D), and the blocks (B, P, 3, 3) of the points."""
        size = self.whitened.shape[1]
        eye = torch.eye(size, dtype=self.root.dtype, device=self.root.device)
        inverse = self.reduced.solve(eye.expand(len(self.root), size, size))
        A = self.whitened.unflatten(-1, (3, -1)).permute(0, 3, 2, 1)  # (B, P, 3, D)
        root = self.root.permute(0, 3, 1, 2)
        inner = torch.eye(3, dtype=A.dtype, device=A.device) + (A @ inverse[:, None]) @ A.mT
        return inverse, root.mT @ inner @ root


def factorized_grid(
    equations: GridEquations,
    free: Tensor,
    free_points: Tensor,
    num_camera: int,
    damping: Tensor | None = None,
    gauge: Tensor | None = None,
) -> FactorizedGrid:
    """Eliminate the points and factorise what is left, as `NormalEquations.factorized` does.

    free: (B, F); free_points: (B, P); num_camera: rows at the end that are no frames'; damping: (B,)
    gauge: (B, 6 F, g)
    """
    root = _inverse_root(equations.points, free_points, damping)
    c0, c1, c2 = equations.coupling.unbind(2)
    q = root[:, None].unbind(2)
    whitened = torch.stack(
        (
            q[0][:, :, 0] * c0,
            q[1][:, :, 0] * c0 + q[1][:, :, 1] * c1,
            q[2][:, :, 0] * c0 + q[2][:, :, 1] * c1 + q[2][:, :, 2] * c2,
        ),
        dim=2,
    ).flatten(2)
    reduced, frames = equations.reduced, equations.reduced.shape[-1] - num_camera
    if damping is not None:  # a frame that lost all its observations stays solvable: its step is zero
        growth = damping[:, None] * reduced.diagonal(dim1=-2, dim2=-1)
        growth[:, :frames] += torch.finfo(growth.dtype).tiny ** 0.5
        reduced = reduced + torch.diag_embed(growth)
    reduced = torch.baddbmm(reduced, whitened, whitened.mT, alpha=-1)
    if gauge is not None:
        c = gauge * _mean_of(reduced, free, num_camera).sqrt()[:, None, None]
        c = torch.nn.functional.pad(c, (0, 0, 0, num_camera))
        reduced = torch.baddbmm(reduced, c, c.mT)
    return FactorizedGrid(root, whitened, factorize(reduced, strict=damping is None))


def _mean_of(reduced: Tensor, free: Tensor, num_camera: int) -> Tensor:
    """(B,) mean of the diagonal, without the rows that only fill up: each problem has the one that it has alone."""
    diagonal = reduced.diagonal(dim1=-2, dim2=-1)
    if free.all():
        return diagonal.mean(-1)
    rows = torch.nn.functional.pad(free.repeat_interleave(6, dim=1), (0, num_camera), value=True)
    return torch.where(rows, diagonal, 0.0).sum(-1) / rows.sum(-1).clamp_min(1)


def _inverse_root(blocks: Tensor, free: Tensor, damping: Tensor | None) -> Tensor:
    """`inverse_root_3x3` of blocks (B, 3, 3, P), with diagonals grown by the share `damping`, where they are free."""
    diagonal = blocks.diagonal(dim1=1, dim2=2).mT
    if damping is not None:
        diagonal = diagonal * (1 + damping[:, None, None])
    d0, d1, d2 = diagonal.unbind(1)
    lower = d0, blocks[:, 1, 0], d1, blocks[:, 2, 0], blocks[:, 2, 1], d2
    smallest = torch.finfo(blocks.dtype).eps ** 0.8 if damping is None else 0.0
    q00, q10, q11, q20, q21, q22 = inverse_root_3x3(lower, free, smallest)
    zero = torch.zeros_like(q00)
    return torch.stack((q00, zero, zero, q10, q11, zero, q20, q21, q22), dim=1).unflatten(1, (3, 3))
