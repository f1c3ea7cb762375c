"""What priors on poses and cameras add to the normal equations of a bundle adjustment."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.optim.bundle.problem import Inputs
from torchslam.optim.core.priors import PosePrior, prior_expansion, prior_hessian
from torchslam.optim.core.tangent import turned


class PriorTerms(NamedTuple):
    """Cost (...), and gradients and Hessians over frames, (..., F, 6), (..., F, 6, 6), and the cameras' n free
    directions each, (..., C n), (..., C n, C n)."""

    cost: Tensor
    frames_gradient: Tensor
    frames: Tensor
    camera_gradient: Tensor
    camera: Tensor

    def in_world(self, R_cw: Tensor) -> PriorTerms:
        """The same for frames (..., F, 3, 3) that move along the axes of the world."""
        frames = turned(R_cw.mT, turned(R_cw.mT, self.frames).mT)
        gradient = turned(R_cw.mT, self.frames_gradient[..., None])[..., 0]
        return self._replace(frames_gradient=gradient, frames=frames)


def prior_terms(
    inputs: Inputs, T_cw: Tensor, params: Tensor, moving: Tensor, directions: Tensor | None, exact: bool
) -> PriorTerms | None:
    """The terms at poses (..., F, 4, 4) and parameters (..., C, K); None where there are no priors.

    moving: (..., F) bool, of which frames the prior counts; directions: (K, n), none where the camera is fixed
    exact:  the exact Hessian, not that of Gauss and Newton
    """
    poses, camera = inputs.pose_prior, inputs.camera_prior
    if poses is None and camera is None:
        return None
    cost = T_cw.new_zeros(T_cw.shape[:-3])
    g_frames, H_frames = T_cw.new_zeros(*T_cw.shape[:-2], 6), T_cw.new_zeros(*T_cw.shape[:-2], 6, 6)
    if poses is not None:
        poses = PosePrior(poses.T_cw, torch.where(moving[..., None, None], poses.information, 0.0))
        costs, g_frames, H_frames = prior_expansion(poses, T_cw)
        cost = cost + costs.sum(-1)
        if exact:
            flat = PosePrior(poses.T_cw.reshape(-1, 4, 4), poses.information.reshape(-1, 6, 6))
            H_frames = prior_hessian(flat, T_cw.reshape(-1, 4, 4)).view_as(H_frames)
    free = 0 if directions is None else directions.shape[-1]
    g_camera = params.new_zeros(*params.shape[:-1], free)
    H_camera = params.new_zeros(*g_camera.shape, free)
    if camera is not None and directions is not None:
        off = params - camera.params
        pulled = (camera.information @ off[..., None]).squeeze(-1)
        cost = cost + 0.5 * (off * pulled).sum((-2, -1))
        g_camera, H_camera = pulled @ directions, directions.mT @ camera.information @ directions
    return PriorTerms(cost, g_frames, H_frames, g_camera.flatten(-2), block_diagonal(H_camera))


def block_diagonal(blocks: Tensor) -> Tensor:
    """(..., N, D, D) -> (..., N D, N D)."""
    rows = torch.diag_embed(blocks.movedim(-3, -1), dim1=-4, dim2=-2)
    return rows.flatten(-2).flatten(-3, -2)


def still_open(motions: Tensor, H_frames: Tensor) -> Tensor:
    """Of orthonormal motions (..., F, 6, g) of all frames those that priors (..., F, 6, 6) do not hinder; else zero."""
    held = torch.einsum("...fag,...fab,...fbh->...gh", motions, H_frames, motions)
    stiffness, mixtures = torch.linalg.eigh(held)
    is_open = stiffness <= torch.finfo(held.dtype).eps ** 0.5 * stiffness[..., -1:]
    return motions @ (mixtures * is_open[..., None, :])[..., None, :, :]
