"""Keypoints of one image in undistorted coordinates: what a pose is found from without passing the distortion again."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.gating import Noise
from torchslam.geometry.whitening import whitening


@dataclass(frozen=True)
class Undistorted:
    """Keypoints (N,) of a camera, undistorted once; coordinates come first in memory.

    xy:    (2, N) undistorted image coordinates, x/z and y/z
    slope: (2, 2, N) d pixel / d xy there: slope[j, i] is that of pixel coordinate i in xy[j]
    """

    xy: Tensor
    slope: Tensor

    @classmethod
    def of(cls, pixels: Tensor, camera: Camera) -> Undistorted:
        """Of pixels (N, 2) of one camera."""
        xy = camera.normalize(pixels)
        if camera.model == "pinhole":
            slope = torch.diag(camera.params[:2])[..., None].expand(2, 2, len(pixels))
        else:
            _, _, J = camera.project_with_point_jacobians(torch.cat((xy, torch.ones_like(xy[:, :1])), dim=1))
            slope = J[..., :2].permute(2, 1, 0)
        return cls(xy.mT.contiguous(), slope.contiguous())

    def __getitem__(self, rows: Tensor) -> Undistorted:
        """Some of the keypoints, by index (n,)."""
        return Undistorted(self.xy.index_select(1, rows), self.slope.index_select(2, rows))

    def whitened(self, noise: Noise) -> Tensor:
        """(2, 2, N) slopes in units of the noise (N,) of the keypoints: times an error in xy, to first order, they are
        an error of covariance one. Noise whose inverse covariance is not definite gives zero."""
        if noise.information.shape[-1] < 3:
            return self.slope / noise.sigmas
        return torch.einsum("nki,jin->jkn", whitening(noise.weights), self.slope)
