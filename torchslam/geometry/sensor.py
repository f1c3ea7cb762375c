"""The sensor model: the map from a point of the scene to a keypoint, and from there to undistorted coordinates.

Camera, readout of the shutter and noise are one value, replaced as a whole. The keypoints of a frame are corrected by
it once (`SensorModel.at_middle_row`); from then on every stage works with the keypoints of a global shutter, and poses
are found from their undistorted coordinates without passing the distortion again.
"""

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
from torchslam.geometry.lie import homogeneous, se3_exp_transform
from torchslam.geometry.rolling_shutter import Readout, row_fractions
from torchslam.utils.by_value import ByValue


@dataclass(frozen=True, eq=False)
class UndistortedKeypoints(ByValue):
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
            _, _, J = camera.project_with_point_jacobians(homogeneous(xy))
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
        """Slopes in units of the noise: times an error in xy, to first order, an error of covariance one.

        Noise whose inverse covariance is not definite gives zero.
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
        """Pixels from node to node, along x and y: two, or more for a table of at most 2^17 nodes."""
        width, height = self.camera.size
        # The bend of a distortion over one pixel is some thousandths of one.
        return self.camera.params.new_tensor(max(2.0, math.sqrt(width * height / 2**17)))

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
        projected, valid = self.camera.project(homogeneous(exact.xy.mT))
        is_within = valid & (failed == 0) & ((projected - nodes).abs().amax(1) < 0.1)
        inverse = torch.where(is_within[:, None, None], inverse, 0.0).permute(2, 1, 0)
        return torch.cat((exact.xy, exact.slope.flatten(0, 1), inverse.flatten(0, 1))).mT.contiguous()


@dataclass(frozen=True, eq=False)
class SensorModel(ByValue):
    """Camera, shutter and noise of the images of a recording.

    Attributes:
        camera: of all frames.
        readout: of a rolling shutter; None: a global shutter.
        noise_variance: of keypoints, in units of what the feature extractor states, as the final adjustment estimates
            it: the weights of a graph are divided by it.
    """

    camera: Camera
    readout: Readout | None = None
    noise_variance: float = 1.0

    def at_middle_row(
        self,
        detected: Float[Tensor, "K N 2"],
        velocities: Float[Tensor, "K 6"],
        depths: Float[Tensor, "K N"],
        rays: Float[Tensor, "K N 2"] | None = None,
    ) -> Float[Tensor, "K N 2"]:
        """Where a global shutter would have seen the keypoints of K frames, while their middle rows were exposed.

        Args:
            velocities: left perturbations of the poses of the frames per second, translation first.
            depths: of the points that the keypoints see, along the optical axis.
            rays: x/z and y/z of the keypoints; computed if None.
        """
        if self.readout is None:
            return detected
        rays = self.camera.normalize(detected) if rays is None else rays
        points_row = depths[..., None] * homogeneous(rays)
        elapsed = row_fractions(detected, self.camera.height) * self.readout.seconds.to(rays)
        points_c = se3_exp_transform(-elapsed[..., None] * velocities[:, None], points_row)
        pixels, is_valid = self.camera.project(points_c)
        return torch.where(is_valid[..., None], pixels, detected)


class SharedCamera:
    """The sensor model that the components of a running system share, and its undistortion.

    They change when the run adopts another one.
    """

    def __init__(self, camera: Camera, readout: Readout | None = None) -> None:
        self.use(SensorModel(camera, readout))

    @property
    def current(self) -> Camera:
        """The camera of the model."""
        return self.model.camera

    def use(self, model: SensorModel, undistortion: Undistortion | None = None) -> None:
        """Use another sensor model from now on; `undistortion`: of its camera, where it was computed elsewhere."""
        self.model, self.undistortion = model, undistortion or Undistortion(model.camera)

    def at_middle_row(
        self, detected: Float[Tensor, "N 2"], velocity: Float[Tensor, " 6"], depth: Float[Tensor, ""]
    ) -> Float[Tensor, "N 2"]:
        """As `SensorModel.at_middle_row`, of one frame and at one depth."""
        rays = self.undistortion.normalize(detected)[None]
        depths = depth.expand(1, len(detected))
        return self.model.at_middle_row(detected[None], velocity[None], depths, rays)[0]
