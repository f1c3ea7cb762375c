"""Keypoints of one image in undistorted coordinates: what a pose is found from without passing the distortion again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.gating import KeypointNoise, whitening

_NODES = 2**17  # of a table, at most: a node every two pixels of an image of 752 x 480
_LEAST_STEP = 2.0  # pixels: the bend of a distortion over one pixel is some thousandths of one


@dataclass(frozen=True)
class UndistortedKeypoints:
    """Keypoints of one camera, undistorted once; coordinates come first in memory.

    Attributes:
        xy: undistorted image coordinates, x/z and y/z.
        slope: d pixel / d xy there: slope[j, i] is that of pixel coordinate i in xy[j].
    """

    xy: Float[Tensor, "2 N"]
    slope: Float[Tensor, "2 2 N"]

    @classmethod
    def of(cls, pixels: Float[Tensor, "N 2"], camera: Camera) -> UndistortedKeypoints:
        """Undistort pixels of one camera exactly."""
        xy = camera.normalize(pixels)
        if camera.model == "pinhole":
            slope = torch.diag(camera.params[:2])[..., None].expand(2, 2, len(pixels))
        else:
            _, _, J = camera.project_with_point_jacobians(torch.cat((xy, torch.ones_like(xy[:, :1])), dim=1))
            slope = J[..., :2].permute(2, 1, 0)
        return cls(xy.mT.contiguous(), slope.contiguous())

    def __getitem__(self, rows: Int[Tensor, " R"]) -> UndistortedKeypoints:
        """Some of the keypoints, by index."""
        return UndistortedKeypoints(self.xy.index_select(1, rows), self.slope.index_select(2, rows))

    @property
    def pixel_scale(self) -> Float[Tensor, " N"]:
        """Pixels per unit of xy, the mean over all directions."""
        (a, b), (c, d) = self.slope[0].unbind(0), self.slope[1].unbind(0)
        return torch.addcmul(a * d, b, c, value=-1).abs_().sqrt_()

    def whitened(self, noise: KeypointNoise) -> Float[Tensor, "2 2 N"]:
        """Slopes in units of the noise of the keypoints.

        Times an error in xy they are, to first order, an error of covariance one. Noise whose inverse covariance is
        not definite gives zero.
        """
        if noise.information.shape[-1] < 3:
            return self.slope / noise.sigmas
        return torch.einsum("nki,jin->jkn", whitening(noise.weights), self.slope)


class Undistortion:
    """Undistort the keypoints of one camera, frame by frame, without iterations.

    Interpolates linearly from the nearest node of a table: precise to a hundredth of a pixel, two hundredths
    towards the edge of a fisheye. The table is made on first use, or by `prepare`.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    def __call__(self, pixels: Float[Tensor, "N 2"]) -> UndistortedKeypoints:
        """Undistort pixels."""
        if self.camera.model == "pinhole":
            return UndistortedKeypoints.of(pixels, self.camera)
        last = self._size - 1
        at = (pixels.mT / self._step).round_().clamp_(torch.zeros_like(last), last)
        node = (at[1] * self._size[0] + at[0]).long()
        xy, slope, inverse = self._table.index_select(0, node).mT.contiguous().split((2, 4, 4))
        off = torch.addcmul(pixels.mT, at, self._step, value=-1)
        return UndistortedKeypoints(xy + (inverse.view(2, 2, -1) * off[:, None]).sum(0), slope.view(2, 2, -1))

    def prepare(self) -> Self:
        """Make the table now rather than on first use."""
        if self.camera.model != "pinhole":
            _ = self._table
        return self

    def normalize(self, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """As `Camera.normalize`, from the table."""
        if self.camera.model == "pinhole":
            return self.camera.normalize(pixels)
        return self(pixels.reshape(-1, 2)).xy.mT.reshape(pixels.shape)

    @cached_property
    def _step(self) -> Float[Tensor, ""]:
        """Pixels from node to node, along x and y."""
        width, height = self.camera.size
        return self.camera.params.new_tensor(max(_LEAST_STEP, math.sqrt(width * height / _NODES)))

    @cached_property
    def _size(self) -> Float[Tensor, "2 1"]:
        """Columns and rows of nodes."""
        return (self.camera.params.new_tensor(self.camera.size)[:, None] / self._step).ceil() + 1

    @cached_property
    def _table(self) -> Float[Tensor, "nodes 10"]:
        """Of the nodes, row by row: xy, slope and its inverse, d xy / d pixel."""
        columns, rows = (torch.arange(int(count), device=self._step.device) for count in self._size)
        nodes = torch.cartesian_prod(rows, columns).flip(1) * self._step
        exact = UndistortedKeypoints.of(nodes, self.camera)
        # slope[j, i] to inverse[i, j]
        inverse, failed = torch.linalg.inv_ex(exact.slope.permute(2, 1, 0))
        # Beyond the monotone part of the distortion all pixels get its edge.
        ray = torch.cat((exact.xy, torch.ones_like(exact.xy[:1]))).mT
        projected, valid = self.camera.project(ray)
        is_within = valid & (failed == 0) & ((projected - nodes).abs().amax(1) < 0.1)
        inverse = torch.where(is_within[:, None, None], inverse, 0.0)
        inverse = inverse.permute(2, 1, 0)
        return torch.cat((exact.xy, exact.slope.flatten(0, 1), inverse.flatten(0, 1))).mT.contiguous()
