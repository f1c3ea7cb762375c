"""Whether a camera whose focal length is uncertain only turned, in which case its images hold no map.

With a wrong focal length no rotation explains the matches of a camera that turned, and a translation seems to: a map of
it contradicts nothing. A rotation with another focal length, the same for all pairs, explains them as well.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.rotating_camera import fit_rotating_camera
from torchslam.global_mapping.view_graph import ViewPair
from torchslam.tracking.turning_camera import MOST_FOCAL_STD
from torchslam.types import FrameFeatures

TURNED = 0.5
"""Share of the pairs that a rotation explains from which on the camera only turned. In 24 rendered turns by 15 to 60
degrees, with focal lengths given as .75 to 2.2 of the true one, it explains all; of garden, courthouse, office_loop,
machine_hall and 93 parts of 6 or 12 images of them, at most .2, with standard deviations of .02 and .3."""
_PAIRS, _MATCHES = 32, 200
"""Most pairs, spread over all images, and most matches of each that are tried. Tried at these values only."""
_SHARED_STD = 1e-3
"""Relative standard deviation of the camera that all pairs share, about the median of theirs. Tried at this value
only."""


@torch.no_grad()
def turning_focal(
    pairs: list[ViewPair], views: list[FrameFeatures], given: CameraMeasurement, threshold_px: float
) -> float | None:
    """The focal length, in pixels, with which a turning camera explains the pairs; None if none explains most.

    Args:
        pairs: verified, by first, then second image.
        views: images.
        given: the camera with its error.
        threshold_px: distance from the epipolar line up to which matches were verified.
    """
    # The furthest pair of each image: near ones show little of a motion.
    furthest = list({pair.first: pair for pair in pairs}.values())
    chosen = furthest[:: -(-len(furthest) // _PAIRS)]
    pixels_1, pixels_2, mask = _matches(chosen, views)
    std = min(given.focal_std, MOST_FOCAL_STD)
    own = fit_rotating_camera(pixels_1, pixels_2, given.camera, std, threshold_px, mask)
    shared = own.camera.with_params(own.camera.params.median(0).values)
    turned = fit_rotating_camera(pixels_1, pixels_2, shared, _SHARED_STD, threshold_px, mask)
    explained = own.explains(mask, threshold_px) & turned.explains(mask, threshold_px)
    return float(shared.focal) if float(explained.double().mean()) > TURNED else None


def _matches(
    pairs: list[ViewPair], views: list[FrameFeatures]
) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
    """The keypoints of some matches of each pair, and which rows are filled."""
    size = min(_MATCHES, max(map(len, pairs)))
    pixels = views[0].keypoints.new_zeros(2, len(pairs), size, 2)
    mask = torch.zeros(len(pairs), size, dtype=torch.bool, device=pixels.device)
    for row, pair in enumerate(pairs):
        count = min(size, len(pair))
        rows = (
            torch.linspace(0, len(pair) - 1, count, dtype=pixels.dtype, device=pixels.device).round().long()
        )
        pixels[0, row, :count] = views[pair.first].keypoints[pair.keypoints_1[rows]]
        pixels[1, row, :count] = views[pair.second].keypoints[pair.keypoints_2[rows]]
        mask[row, :count] = True
    return pixels[0], pixels[1], mask
