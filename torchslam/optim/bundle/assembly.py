"""From second-order expansions per observation to the normal equations over poses, points and camera.

Frames move along the axes of the world: seen from there, a point that lies at the ray r from the camera moves to first
order as dp = v + omega x r + dX, so that the Hessian C of an observation in its point is also that against v, and
r x C against omega. To second order the rotation adds omega x (omega x r) / 2 + omega x dX.
Rows run along the observations: every operation streams through contiguous memory.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.optim.bundle.schur import NormalEquations, Structure, Tangent
from torchslam.optim.core.residuals import Expansion


def assemble(
    structure: Structure, expansion: Expansion, rays_w: Tensor, free_points: Tensor, exact: bool
) -> NormalEquations:
    """Normal equations of observations ordered as `structure` asks, for frames that move along the world's axes.

    expansion: gradient (3 + K, O) and Hessian (3 + K, 3 + K, O) in the points in the world and the camera
    rays_w:    (3, O) from the observing camera to the point, in the axes of the world
    exact:     include the second-order terms of the rotation, for the exact Hessian
    """
    gradient, hessian = expansion
    slope, linked = gradient[:3], structure.num_linked
    # The columns of all blocks: against points, the gradient, against the camera.
    moved = torch.cat((hessian[:3, :3], slope[:, None], hessian[:3, 3:]), dim=1)
    points = structure.sum_by_point(moved.flatten(0, 1).mT).unflatten(-1, (3, -1))
    slope, rays_w, moved = slope[:, :linked], rays_w[:, :linked], moved[..., :linked]
    turned = _cross(rays_w, moved)
    twice = _cross(rays_w, turned[:, :3].transpose(0, 1))
    against_points = turned[:, :3]
    if exact:
        eye = torch.eye(3, dtype=slope.dtype, device=slope.device)[..., None]
        against_points = against_points - _cross(slope, eye)
        outer = slope[:, None] * rays_w
        twice = twice + 0.5 * (outer + outer.transpose(0, 1)) - outer.diagonal().sum(-1) * eye
    blocks = torch.cat((moved[:, :3], against_points)).permute(2, 1, 0).reshape(-1, 6)
    coupling = blocks.new_zeros(structure.storage_rows, 6).index_add_(0, structure.coupling, blocks)
    moved, turned, twice = (structure.sum_by_frame(values) for values in (moved, turned, twice))
    upper = torch.cat((moved[..., :3], turned[..., :3].mT), dim=-1)
    lower = torch.cat((turned[..., :3], twice), dim=-1)
    rest = torch.cat((moved[..., 3:], turned[..., 3:]), dim=1)
    return NormalEquations(
        structure,
        Tangent(rest[..., 0], points[..., 3], gradient[3:].sum(-1)),
        torch.cat((upper, lower), dim=1),
        points[..., :3],
        hessian[3:, 3:].sum(-1),
        rest[..., 1:],
        points[..., 4:],
        coupling,
        free_points,
    )


def product(A: Tensor, B: Tensor) -> Tensor:
    """A B of matrices (m, 3, O) and (3, n, O). -> (m, n, O)."""
    first = A[:, 0, None] * B[0]
    return first.addcmul(A[:, 1, None], B[1]).addcmul(A[:, 2, None], B[2])


def _cross(u: Tensor, columns: Tensor) -> Tensor:
    """u x every column: (3, O), (3, n, O) -> (3, n, O)."""
    pairs = ((1, 2), (2, 0), (0, 1))
    return torch.stack([(u[i] * columns[j]).addcmul(u[j], columns[i], value=-1) for i, j in pairs])
