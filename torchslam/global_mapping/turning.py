"""Whether a camera whose focal length is uncertain only turned, in which case its images hold no map.

With a wrong focal length no rotation explains the matches of a camera that turned, and a translation seems to: a map of
it contradicts nothing. A rotation with another focal length, the same for all pairs, explains them as well.
"""

from __future__ import annotations

import torch

from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.rotating_camera import fit_rotating_camera
from torchslam.global_mapping.view_graph import MatchedPair, ViewPair, padded_matches
from torchslam.tracking.turning_camera import MOST_FOCAL_STD
from torchslam.types import FrameFeatures

TURNED = 0.5
"""Share of the pairs that a rotation explains from which on the camera only turned. In 24 rendered turns by 15 to 60
degrees, with focal lengths given as .75 to 2.2 of the true one, it explains all; of garden, courthouse, office_loop,
machine_hall and 93 parts of 6 or 12 images of them, at most .2, with standard deviations of .02 and .3."""
_PAIRS, _MATCHES = 32, 200
"""Most pairs, spread over all images, and most matches of each that are used. With every second match, one part of 6
images of garden has .4. Tried at these values only."""
_SHARED_STD = 1e-3
"""Relative standard deviation of the camera that all pairs share, about the median of theirs. Tried at this value
only."""


@torch.no_grad()
def turning_focal(
    pairs: list[ViewPair], views: list[FrameFeatures], given: CameraMeasurement, threshold_px: float
) -> float | None:
    """The focal length, in pixels, with which a turning camera explains the pairs; None if none explains most.

    Args:
        pairs: verified.
        views: images.
        given: the camera with its error.
        threshold_px: distance from the epipolar line up to which matches were verified.
    """
    # The furthest pair of each image: near ones show little of a motion.
    furthest = list({pair.first: pair for pair in sorted(pairs, key=lambda pair: pair.second)}.values())
    if not furthest:
        return None
    found = [_some_matches(pair) for pair in furthest[:: -(-len(furthest) // _PAIRS)]]
    pixels_1, pixels_2, mask = padded_matches(views, found, given.camera.params)
    std = min(given.focal_std, MOST_FOCAL_STD)
    own = fit_rotating_camera(pixels_1, pixels_2, given.camera, std, threshold_px, mask)
    explained = own.explains(mask, threshold_px)
    if float(explained.double().mean()) <= TURNED:
        return None
    shared = own.camera.with_params(own.camera.params.median(0).values)
    turned = fit_rotating_camera(pixels_1, pixels_2, shared, _SHARED_STD, threshold_px, mask)
    explained &= turned.explains(mask, threshold_px)
    return float(shared.focal) if float(explained.double().mean()) > TURNED else None


def _some_matches(pair: ViewPair) -> MatchedPair:
    """At most `_MATCHES` matches of a pair, spread evenly."""
    count = min(_MATCHES, len(pair))
    rows = torch.linspace(0, len(pair) - 1, count, dtype=torch.float64, device=pair.keypoints_1.device)
    rows = rows.round().long()
    return pair.first, pair.second, pair.keypoints_1[rows], pair.keypoints_2[rows]
