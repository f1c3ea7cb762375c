"""A rolling shutter: the rows of an image are exposed one after the other, each at a pose of its own.

The time from the first row to the last is the readout. A frame's pose is that of the middle of its image; a row at a
fraction r of the height from there, -1/2 to 1/2, is exposed by r times the readout later. During this time the camera
moves on with its velocity, which the poses of the frames before and after give.

Source of the model: Hedborg et al., "Rolling shutter bundle adjustment", CVPR 2012.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_exp, se3_exp_transform, se3_inverse, se3_log, so3_exp, transform
from torchslam.geometry.precision import full_precision, without_autocast

MAX_GAP = 1.5
"""Frame intervals between two frames whose poses still give a velocity: a missing frame makes it two. Tried at this
value only."""
MAX_READOUT = 1e4
"""Largest readout in seconds that is read from a file. Cameras need .005 to .06, but timestamps may count frames."""


@dataclass(frozen=True)
class Readout:
    """The readout of a camera with its error, from a prior and the images of a run.

    Attributes:
        seconds: from the first row to the last; negative if the last row is exposed first.
        std: standard error, seconds.
        prior: what was known before, seconds.
        prior_std: its standard deviation, seconds.
    """

    seconds: Float[Tensor, ""]
    std: float
    prior: float
    prior_std: float

    @classmethod
    def known(cls, seconds: float, std: float) -> Self:
        """A prior, before images say more."""
        return cls(torch.tensor(seconds, dtype=torch.float64, device="cpu"), std, seconds, std)

    @classmethod
    def from_numbers(cls, numbers: Tensor) -> Self:
        """Read the four `numbers` of a file. Raises ValueError for numbers that are none."""
        if numbers.shape != (4,) or numbers.dtype != torch.float64:
            raise ValueError(f"the readout is {tuple(numbers.shape)} of {numbers.dtype}, not four float64")
        if not bool(numbers.isfinite().all()) or bool((numbers[[0, 2]].abs() > MAX_READOUT).any()):
            raise ValueError(f"the readout is not finite, or above {MAX_READOUT:g} s")
        if bool((numbers[[1, 3]] < 0).any()):
            raise ValueError("the readout has a negative standard deviation")
        return cls(numbers[0].clone(), *numbers[1:].tolist())

    @property
    def numbers(self) -> Float[Tensor, " 4"]:
        """As files have them."""
        numbers = float(self.seconds), self.std, self.prior, self.prior_std
        return torch.tensor(numbers, dtype=torch.float64, device="cpu")

    @property
    def is_given(self) -> bool:
        """Whether there is a rolling shutter by what was known."""
        return self.prior != 0

    @property
    def is_sought(self) -> bool:
        """Whether images may show one of which nothing was known."""
        return self.prior == 0 and self.prior_std > 0

    def updated(self, seconds: float, std: float) -> Self:
        """The mean of the prior and of an estimate from images, weighted by their information."""
        if not math.isfinite(std) or not self.prior_std:
            return self
        share = self.prior_std**2 / (self.prior_std**2 + std**2)
        mean = self.prior + share * (seconds - self.prior)
        return replace(self, seconds=torch.full_like(self.seconds, mean), std=std * math.sqrt(share))

    def description(self) -> str:
        """The value and its error in milliseconds."""
        return f"{1e3 * float(self.seconds):.1f} ± {1e3 * self.std:.1f} ms"


def row_fractions(pixels: Float[Tensor, "*batch 2"], height: int) -> Float[Tensor, "*batch"]:
    """The rows of pixels as fractions of the image's height from its middle, -1/2 to 1/2."""
    return (pixels[..., 1] + 0.5) / height - 0.5


@full_precision
def row_poses(
    T_cw: Float[Tensor, "*#batch 4 4"],
    velocities: Float[Tensor, "*#batch 6"],
    fractions: Float[Tensor, "*#batch"],
    readout: Float[Tensor, "*#readout"],
) -> Float[Tensor, "*batch 4 4"]:
    """The poses at rows: exp(r readout v) T_cw, of poses at the middle row and `row_fractions` r; readout in seconds.

    Velocities are left perturbations of the poses per second, translation first.
    """
    return se3_exp((fractions * readout)[..., None] * velocities) @ T_cw


@full_precision
def global_shutter_pixels(
    pixels: Float[Tensor, "*batch N 2"],
    T_cw: Float[Tensor, "*#batch N 4 4"],
    velocities: Float[Tensor, "*#batch N 6"],
    points_w: Float[Tensor, "*#batch N 3"],
    camera: Camera,
    readout: Float[Tensor, "*#readout"],
) -> Float[Tensor, "*batch N 2"]:
    """Where the keypoints would be if all rows were exposed with the one in the middle.

    A keypoint is moved by the difference between the images of its point at the pose of the frame and at that of the
    row, unless one of the two is invalid.

    Args:
        T_cw: pose of the frame of each keypoint.
        velocities: of that frame, per second, see `row_poses`.
        readout: seconds; a scalar, or of any shape that broadcasts with (..., N).
    """
    fractions = row_fractions(pixels, camera.height)
    points_c = transform(T_cw, points_w[..., None, :])[..., 0, :]
    points_row = se3_exp_transform((fractions * readout)[..., None] * velocities, points_c)
    at_row, is_valid = camera.project(points_row)
    at_middle, is_valid_too = camera.project(points_c)
    return pixels + torch.where((is_valid & is_valid_too)[..., None], at_middle - at_row, 0.0)


def at_middle_row(
    pixels: Float[Tensor, "B N 2"], camera: Camera, turns: Float[Tensor, "B 3"]
) -> Float[Tensor, "B N 2"]:
    """Where a camera that only turns sees points of any distance while its middle row is exposed.

    turns: rotation vectors from the first row to the last one
    """
    R = so3_exp(-row_fractions(pixels, camera.height)[..., None] * turns[:, None])
    return camera.project((R @ camera.unproject(pixels)[..., None])[..., 0])[0]


@without_autocast
def frame_velocities(
    T_cw: Float[Tensor, "K 4 4"],
    timestamps: Float[Tensor, " K"],
    recordings: Int[Tensor, " K"] | None = None,
    frames: Int[Tensor, " R"] | None = None,
) -> tuple[Float[Tensor, "K 6"], Bool[Tensor, " K"]]:
    """The velocity of each frame from the poses of the frames before and after, a left perturbation per second.

    Differentiable with respect to the poses. Frames that are more than `MAX_GAP` frame intervals apart are no
    neighbors. A frame with one neighbor has the velocity from there to it, one without any has none.

    Args:
        timestamps: seconds, in any order.
        recordings: frames with different numbers are no neighbors; one recording if omitted.
        frames: rows whose velocities are computed, the others are zero; all if omitted.

    Returns:
        Velocities, zero without neighbors, and which frames have neighbors on both sides.
    """
    order = torch.argsort(timestamps, stable=True)
    if recordings is not None:
        order = order[torch.argsort(recordings[order], stable=True)]
    intervals = timestamps[order].diff()
    follows = intervals > 0
    if recordings is not None:
        follows = follows & (recordings[order].diff() == 0)
    if bool(follows.any()):
        follows = follows & (intervals < MAX_GAP * intervals[follows].median())
    has_before, has_after = (torch.nn.functional.pad(follows, ends) for ends in ((1, 0), (0, 1)))
    velocities = torch.zeros_like(T_cw[:, 0, :1]).expand(len(T_cw), 6)
    is_central = torch.zeros_like(has_before).index_copy(0, order, has_before & has_after)
    is_wanted = has_before | has_after
    if frames is not None:
        is_wanted = is_wanted & torch.zeros_like(is_wanted).index_fill(0, frames, True)[order]
    place = is_wanted.nonzero()[:, 0]
    before, after = order[place - has_before[place].long()], order[place + has_after[place].long()]
    elapsed = (timestamps[after] - timestamps[before]).to(T_cw.dtype)
    steps = se3_log(T_cw[after] @ se3_inverse(T_cw[before])) / elapsed[:, None]
    return velocities.index_copy(0, order[place], steps), is_central
