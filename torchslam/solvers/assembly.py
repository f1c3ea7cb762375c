"""From second-order expansions per observation to the normal equations over poses, points and camera.

To first order a point in the camera frame moves with its pose and its world position as dp = G xi + R dX, G = [I, -p^];
to second order the rotation adds omega x (omega x p) / 2 + omega x (R dX).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry.lie import skew
from torchslam.solvers.residuals import Expansion
from torchslam.solvers.schur import NormalEquations, Structure, Tangent


def assemble(
    structure: Structure,
    expansion: Expansion,
    points_c: Tensor,
    R_cw: Tensor,
    free_points: Tensor,
    exact: bool,
) -> NormalEquations:
    """Normal equations of observations ordered as `structure` asks.

    expansion: gradient (O, 3 + K) and Hessian (O, 3 + K, 3 + K) in the camera-frame points and the camera
    points_c:  (O, 3); R_cw: (O, 3, 3) rotations of the observing frames
    exact:     include the second-order terms of the rotation, for the exact Hessian
    """
    gradient, hessian = expansion.gradient, expansion.hessian
    slope, curve = gradient[:, :3], hessian[:, :3, :3]
    linked = structure.num_linked

    # Points: R^T C R and R^T q.
    rotated = curve @ R_cw
    points = structure.sum_by_point(
        torch.cat(
            (R_cw.mT @ rotated, R_cw.mT @ torch.cat((slope[..., None], hessian[:, :3, 3:]), dim=-1)), dim=-1
        )
    )
    # Pose against point: G^T C R.
    turned = torch.linalg.cross(points_c[:linked, :, None].expand(linked, 3, 3), rotated[:linked], dim=1)
    if exact:
        turned = turned - skew(slope[:linked]) @ R_cw[:linked]
    blocks = torch.cat((rotated[:linked], turned), dim=1)
    coupling = blocks.new_zeros(structure.storage_rows, 6)
    coupling = coupling.index_add_(0, structure.coupling, blocks.mT.reshape(-1, 6))

    frames = _sum_by_frame(structure, points_c[:linked], gradient[:linked], hessian[:linked], exact)
    return NormalEquations(
        structure,
        Tangent(frames[..., -1], points[..., 3], gradient[:, 3:].sum(0)),
        frames[..., :6],
        points[..., :3],
        hessian[:, 3:, 3:].sum(0),
        frames[..., 6:-1],
        points[..., 4:],
        coupling,
        free_points,
    )


def _sum_by_frame(
    structure: Structure, points_c: Tensor, gradient: Tensor, hessian: Tensor, exact: bool
) -> Tensor:
    """[G^T C G, G^T C_camera, G^T q] summed over each free frame's observations, (F, 6, 6 + K + 1)."""
    slope, curve = gradient[:, :3], hessian[:, :3, :3]
    count = points_c.shape[0]
    # C (-p^) row by row is p x row.
    curve_turned = torch.linalg.cross(points_c[:, None, :].expand(count, 3, 3), curve, dim=2)
    right = torch.cat((curve, curve_turned, hessian[:, :3, 3:], slope[..., None]), dim=-1)
    eye = torch.eye(3, dtype=points_c.dtype, device=points_c.device)
    G = torch.cat((eye.expand(count, 3, 3), -skew(points_c)), dim=-1)
    sums, begin = [], 0
    for end in structure.frame_ends:
        total = G[begin:end].flatten(0, 1).mT @ right[begin:end].flatten(0, 1)
        if exact:
            outer = slope[begin:end].mT @ points_c[begin:end]
            bend = 0.5 * (outer + outer.mT) - outer.trace() * eye
            total = total + torch.nn.functional.pad(bend, (3, total.shape[1] - 6, 3, 0))
        sums.append(total)
        begin = end
    return torch.stack(sums) if sums else right.new_zeros(0, 6, right.shape[-1])
