"""The convention of given poses by image pairs: inverted, with other camera axes, or with centers for translations.

Every reading of the poses predicts the epipolar lines of image pairs, and the part of them in front of both cameras.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import rigid
from torchslam.geometry.transforms import signed_axes
from torchslam.geometry.two_view_matrices import epipolar_offsets

TOLERANCES = (0.005, 0.012, 0.025)
"""Distance, in focal lengths, of half of the matches of a pair that agrees from where a reading allows them, for exact
poses and for noisy ones. Tried at these values only."""
MATCHES, MIN_PAIRS, MAX_PAIRS = 20, 8, 200
"""Matches of a pair that are compared, and least and largest number of pairs. Tried at these values only."""
MIN_FITTING, MAX_AS_GIVEN = 0.8, 0.5
"""Least share of pairs that agree with another reading, and largest share, relative to it, that agrees with the one of
the format, so that it is named. Tried at these values only."""
TIED = 1.0
"""Standard errors of the number of pairs that agree with the best reading alone, less those with another one alone, up
to which both fit equally. Of 215 cases of 5 to 20 images in which readings are named, the right one is the only one in
179 and among others in 35; with 2, in 140 and 75."""
_DIRECTIONS = (("right", "left"), ("down", "up"), ("forward", "backward"))


class Reading(NamedTuple):
    """A reading of poses.

    Attributes:
        inverted: rotations are the inverse of what the format defines.
        swapped: translations are centers where the format has translations, or the reverse, given the rotations.
        axes: columns are the axes of the file's camera, in x right, y down, z forward.
        share: of the pairs that agree.
    """

    inverted: bool
    swapped: bool
    axes: Float[Tensor, "3 3"]
    share: float

    @property
    def changes(self) -> int:
        """How rare the reading is: inverted or OpenGL's axes count one, other axes or centers two, mirrored three."""
        simple = self.axes.new_tensor(((1.0, 1.0, 1.0), (1.0, -1.0, -1.0)))  # as they are, and OpenGL's
        known = [torch.equal(self.axes, torch.diag(each)) for each in simple]
        of_axes = known.index(True) if any(known) else 2 + int(torch.linalg.det(self.axes) < 0)
        return self.inverted + 2 * self.swapped + of_axes

    def sentence(self, of_format: str, axes_of_format: Float[Tensor, "3 3"]) -> str:
        """What the poses seem to be, for a message; of_format: "world to camera" or "camera to world"."""
        other = {"world to camera": "camera to world", "camera to world": "world to camera"}[of_format]
        words = [other if self.inverted else of_format]
        if self.swapped:
            is_center = words[0] == "world to camera"
            words.append(
                f"with the position of the {'camera in the world' if is_center else 'world in the camera'}"
            )
        # Those of the format were turned on the side of the camera alone where that is what comes first.
        axes = self.axes if self.inverted else self.axes @ axes_of_format
        if not torch.equal(axes, axes_of_format):
            ways = [_DIRECTIONS[int(axis.abs().argmax())][int(axis.sum() < 0)] for axis in axes.T]
            words.append(
                "camera axes " + ", ".join(f"{name} {way}" for name, way in zip("xyz", ways, strict=True))
            )
        if float(torch.linalg.det(axes)) < 0:
            words.append("left-handed")
        return ", ".join(words)


def fitting_reading(
    poses: Float[Tensor, "N 4 4"],
    world_to_camera: bool,
    pairs: Int[Tensor, "P 2"],
    pixels_1: Float[Tensor, "P M 2"],
    pixels_2: Float[Tensor, "P M 2"],
    camera: Camera,
) -> tuple[float, list[Reading]]:
    """Find the readings of poses that image pairs agree with.

    Args:
        poses: as the format has them, camera axes x right, y down, z forward.
        world_to_camera: of the format.
        pairs: rows of the poses of two images each.
        pixels_1: matches in the first image of each pair; `pixels_2`: in the second.
        camera: of all images.

    Returns:
        The share of the pairs that agree with the poses as the format defines them; and other readings, if the pairs
        agree with them and not with the first: all that fit equally, the least rare one first.
    """
    if len(pairs) < MIN_PAIRS:
        return 1.0, []
    signed = signed_axes(poses)
    readings, motions = list[Reading](), list[Tensor]()
    for inverted, swapped in product((False, True), repeat=2):
        R_cw = poses[:, :3, :3]
        R_cw = R_cw if world_to_camera != inverted else R_cw.mT
        position = poses[:, :3, 3:]
        is_center = (not world_to_camera) != (inverted != swapped)
        centers = position if is_center else -R_cw.mT @ position
        R_1, R_2 = (R_cw[rows] for rows in pairs.T)
        t_21 = R_2 @ (centers[pairs[:, 0]] - centers[pairs[:, 1]])
        axes = signed[:, None]
        motions.append(rigid(axes @ (R_2 @ R_1.mT) @ axes.mT, (axes @ t_21)[..., 0]))
        readings += [Reading(inverted, swapped, each, 0.0) for each in signed]
    across, along = epipolar_offsets(torch.cat(motions), pixels_1[None], pixels_2[None], camera, camera)
    every = torch.maximum(across.abs(), -along).median(-1).values / camera.focal
    for tolerance in TOLERANCES:
        agrees = every < tolerance
        shares = agrees.double().mean(-1)
        best = agrees[shares.argmax()]
        if shares.max() >= MIN_FITTING and shares[0] < MAX_AS_GIVEN * shares.max():
            lost, gained = (best & ~agrees).sum(-1), (agrees & ~best).sum(-1)
            tied = torch.nonzero(lost - gained <= TIED * (lost + gained).sqrt())[:, 0].tolist()
            found = [readings[row]._replace(share=float(shares[row])) for row in tied]
            return float(shares[0]), sorted(found, key=lambda each: (each.changes, -each.share))
    return float(shares[0]), []
