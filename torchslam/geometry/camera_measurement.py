"""A camera that is known with an error: a calibration is a measurement, and images say more about it.

Published and printed calibrations are wrong by percents: the focal length depends on focus and temperature, and a
distortion that is left out bends a map. `CameraMeasurement` has the given parameters, and directions in which they may
be wrong; bundle adjustments take it as a prior and move the camera along these directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.camera import Camera

# Parameters of a camera that may be free: the logarithm of the focal length, k1 and k2.
FOCAL, K1, K2 = range(3)

OBSERVATION_VARIANCE = 9.0
"""`CameraMeasurement.observation_variance` before a recording has said anything: a point's errors in neighboring frames
are alike, and parts of a trajectory disagree by two to five formal errors. `torchslam.optim.camera_evidence` finds 0.05
to 2 at the end of a run: until then, the recording has little weight. Tried at this value only."""


@dataclass(frozen=True)
class CameraMeasurement:
    """A Gaussian on the parameters of a camera, which is the mean.

    Attributes:
        directions: Columns along which the parameters may be wrong, each by one standard deviation.
        observation_variance: Variance of an observation as far as it determines the camera, in units of the
            stated one. Where a bundle adjustment has observations with their stated weights, the information of the
            camera is multiplied by it.
    """

    camera: Camera
    directions: Float[Tensor, "P n"]
    observation_variance: float = OBSERVATION_VARIANCE

    @classmethod
    def of(cls, camera: Camera, std: float) -> Self:
        """A calibration whose focal length and radial distortion have a relative standard deviation.

        The image of a point at a distance of one focal length from the center moves by `std` of that distance with
        either of them. The principal point counts as exact.
        """
        camera = with_radial_terms(camera)
        return cls(camera, std * intrinsics_directions(camera, [FOCAL, K1, K2]))

    @property
    def information(self) -> Float[Tensor, "P P"]:
        """The information of the parameters, zero across the directions."""
        inverse = torch.linalg.pinv(self.directions)
        return inverse.mT @ inverse

    @property
    def focal_std(self) -> float:
        """Relative standard deviation of the focal length."""
        relative = self.directions[:2].detach() / self.camera.params[:2, None].detach()
        return float(relative.mean(0).norm())

    @property
    def radial_std(self) -> tuple[float, float]:
        """Standard deviations of the first two radial coefficients; zero for a pinhole."""
        if self.camera.model == "pinhole":
            return 0.0, 0.0
        k1, k2 = self.directions[4:6].detach().norm(dim=-1).tolist()
        return k1, k2

    def with_error(self, camera: Camera, covariance: Float[Tensor, "n n"]) -> CameraMeasurement:
        """Another camera with a covariance of the steps along the directions."""
        variances, axes = torch.linalg.eigh(covariance)
        directions = self.directions @ (axes * variances.clamp_min(0.0).sqrt())
        return replace(self, camera=camera, directions=directions)

    def nearest(self, camera: Camera) -> Camera:
        """The camera with what may be wrong as another one has it, and the rest as given."""
        off = camera.params - self.camera.params
        along = self.directions @ (torch.linalg.pinv(self.directions) @ off)
        return camera.with_params(self.camera.params + along)


def may_be_same(found: Camera, given: Camera, std: float) -> bool:
    """Whether a run may have found one camera where another one was given: within five relative standard deviations.

    What a run does not adjust must be equal, to the nine digits of a calibration file.
    """
    one, other = with_radial_terms(found), with_radial_terms(given)
    if one.model != other.model:
        return False
    off = one.params - other.params
    allowed = 5 * CameraMeasurement.of(given, std).directions.norm(dim=-1)
    return bool((off.abs() <= allowed + 1e-8 * other.params.abs()).all())


def intrinsics_directions(camera: Camera, which: list[int]) -> Float[Tensor, "P D"]:
    """Derivatives of the camera's parameters: log focal length, k1, k2."""
    columns = camera.params.new_zeros(len(camera.params), 3)
    columns[:2, FOCAL] = camera.params[:2]
    if camera.model != "pinhole":
        columns[[4, 5], [K1, K2]] = 1.0
    return columns[:, which]


def with_radial_terms(camera: Camera) -> Camera:
    """The same camera in a model with distortion."""
    if camera.model != "pinhole":
        return camera
    return Camera("radial_tangential", torch.cat([camera.params, camera.params.new_zeros(5)]), camera.size)
