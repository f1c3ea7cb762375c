"""The sensor model: the map from a point of the scene to a keypoint.

Camera, readout of the shutter and noise are one value, replaced as a whole. The keypoints of a frame are corrected by
it once (`SensorModel.at_middle_row`); from then on every stage works with the keypoints of a global shutter.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_exp_transform
from torchslam.geometry.rolling_shutter import Readout, row_fractions
from torchslam.geometry.undistorted import Undistortion


@dataclass(frozen=True)
class SensorModel:
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
            detected: pixels of the detected keypoints.
            velocities: left perturbations of the poses of the frames per second, translation first.
            depths: of the points that the keypoints see, along the optical axis.
            rays: x/z and y/z of the keypoints; computed if None.
        """
        if self.readout is None:
            return detected
        rays = self.camera.normalize(detected) if rays is None else rays
        points_row = depths[..., None] * torch.cat((rays, torch.ones_like(rays[..., :1])), dim=-1)
        elapsed = row_fractions(detected, self.camera.height) * self.readout.seconds.to(rays)
        points_c = se3_exp_transform(-elapsed[..., None] * velocities[:, None], points_row)
        pixels, is_valid = self.camera.project(points_c)
        return torch.where(is_valid[..., None], pixels, detected)


class SharedCamera:
    """The sensor model that the components of a running system share; it changes when the run adopts another one.

    Attributes:
        model: The sensor model of the map as it is now.
        undistortion: Of the keypoints of its images.
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
