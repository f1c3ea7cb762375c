"""Which views become keyframes, and which of these see the same things: matches that an epipolar geometry confirms.

Nothing here measures by the given poses, which may be degrees off: they only say which views cannot have seen the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, estimate_relative_pose, se3_inverse, so3_log
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.tracking.correspondences import match_views
from torchslam.types import FrameFeatures

# A view becomes a keyframe where its matches with the last one moved by this share of the image's width, or where
# this share of the matches is lost that the first view after it had.
MOTION, KEPT = 0.08, 0.6
IN_TIME = 4  # keyframes before it that each is compared with
ALIKE = 8  # others that look most like it
MAX_TURN_DEG = 60.0  # between views that look alike, by their given poses
# What a relative rotation may be off from the given poses': a place that only looks alike is seldom seen so alike.
MAX_OFF_DEG = 15.0
THRESHOLD_PX = (
    2.0  # of an image that is not reduced: about the noise, and what a focal length that is 5 % off bends
)
MIN_MATCHES = 20
_AT_ONCE, _MAX_SAMPLES = 16, 500


@dataclass(frozen=True)
class Pair:
    """Two keyframes that see the same: rows of their views, and matching keypoints (m,), (m,).

    R_21: (3, 3) relative rotation by the matches; None where these leave two motions
    """

    first: int
    second: int
    keypoints_1: Tensor
    keypoints_2: Tensor
    R_21: Tensor | None


def choose_keyframes(views: list[FrameFeatures], width: int, config: Config) -> list[int]:
    """Rows of the views that are apart enough, in their order: told by the images alone."""
    chosen, first_matches = [0], 0
    for row in range(1, len(views)):
        last = views[chosen[-1]]
        at_1, at_2 = match_views(last, views[row], config.matching)
        first_matches = max(first_matches, len(at_1))
        motion = torch.linalg.vector_norm(last.keypoints[at_1] - views[row].keypoints[at_2], dim=-1)
        is_far = len(at_1) < KEPT * first_matches or float(motion.median()) > MOTION * width
        if is_far or len(at_1) < MIN_MATCHES:
            chosen.append(row)
            first_matches = 0
    return chosen


def find_pairs(views: list[FrameFeatures], T_cw: Tensor, camera: Camera, config: Config) -> list[Pair]:
    """The pairs of keyframes that see the same things.

    T_cw: (K, 4, 4) of the views, as given
    """
    found = [
        (one, other, *match_views(views[one], views[other], config.matching))
        for one, other in candidates(views, T_cw)
    ]
    found = [pair for pair in found if len(pair[2]) >= MIN_MATCHES]
    pairs: list[Pair] = []
    for start in range(0, len(found), _AT_ONCE):
        pairs += _verified(found[start : start + _AT_ONCE], views, T_cw, camera, config)
    return pairs


def candidates(views: list[FrameFeatures], T_cw: Tensor) -> list[tuple[int, int]]:
    """Pairs (lower row first, ascending) near in time, or alike and turned to the same side by the given poses."""
    places = KeyframeDatabase()
    for row, view in enumerate(views):
        places.add(row, view.descriptors, view.mask)
    axes_w = T_cw[:, 2, :3]  # viewing directions
    near = axes_w @ axes_w.mT > math.cos(math.radians(MAX_TURN_DEG))
    pairs = set()
    for row, view in enumerate(views):
        pairs |= {(other, row) for other in range(max(0, row - IN_TIME), row)}
        keys, scores = places.query(view.descriptors, view.mask)
        alike = keys[scores > 0]
        alike = alike[near[row, alike] & ((alike - row).abs() > IN_TIME)][:ALIKE]
        pairs |= {(min(row, other), max(row, other)) for other in alike.tolist()}
    return sorted(pairs)


def _verified(
    found: list[tuple[int, int, Tensor, Tensor]],
    views: list[FrameFeatures],
    T_cw: Tensor,
    camera: Camera,
    config: Config,
) -> list[Pair]:
    """Those of several pairs whose matches have a relative pose in common that the given ones do not rule out."""
    size = max(len(at_1) for _, _, at_1, _ in found)
    pixels = T_cw.new_zeros(2, len(found), size, 2)
    mask = torch.zeros(len(found), size, dtype=torch.bool, device=T_cw.device)
    for row, (one, other, at_1, at_2) in enumerate(found):
        mask[row, : len(at_1)] = True
        pixels[0, row, : len(at_1)] = views[one].keypoints[at_1]
        pixels[1, row, : len(at_1)] = views[other].keypoints[at_2]
    relative = estimate_relative_pose(
        pixels[0],
        pixels[1],
        camera,
        camera,
        threshold=THRESHOLD_PX * config.features.reduction(camera.size),
        mask=mask,
        seed=config.seed,
        max_samples=_MAX_SAMPLES,
        kernel="truncated",
        min_samples=64,
    )
    pairs = []
    for row, (one, other, at_1, at_2) in enumerate(found):
        inliers = relative.inliers[row, : len(at_1)]
        if int(inliers.sum()) < MIN_MATCHES:
            continue
        is_known = bool(relative.success[row]) or relative.model[row] == "rotation"
        R_21 = relative.T_21[row, :3, :3] if is_known else None
        given = (T_cw[other] @ se3_inverse(T_cw[one]))[:3, :3]
        if R_21 is None or float(so3_log(R_21 @ given.mT).norm()) < math.radians(MAX_OFF_DEG):
            pairs.append(Pair(one, other, at_1[inliers], at_2[inliers], R_21))
    return pairs
