"""When is a frame worth keeping?"""

from __future__ import annotations

import math

import torch

from torchslam.config import KeyframesConfig
from torchslam.geometry import se3_inverse, so3_log, transform
from torchslam.map import Map
from torchslam.tracking import Tracked, Tracker
from torchslam.types import View


def why_keyframe(
    view: View, tracked: Tracked, tracker: Tracker, slam_map: Map, settings: KeyframesConfig
) -> str:
    """Why a tracked frame should become a keyframe, in words; empty when it should not.

    It is compared with its reference keyframe, the one that shares most points with it: by translation as a share
    of the depth of the scene, by rotation, and by the points that both see.
    """
    newest = int(slam_map.keyframes["frame_index"][-1])
    age = view.index - newest
    if age < max(1, settings.min_interval):
        return ""
    T_cr = tracked.T_cw @ se3_inverse(slam_map.T_cw[tracker.reference])
    depth = transform(tracked.T_cw, slam_map.positions_w[tracked.point_ids])[:, 2].median()
    translation = float(torch.linalg.vector_norm(T_cr[:3, 3]) / depth)
    rotation = math.degrees(float(torch.linalg.vector_norm(so3_log(T_cr[:3, :3]))))
    overlap = tracked.inliers / max(tracker.reference_size, 1)
    if translation > settings.max_translation:
        return f"moved by {translation:.2f} of the depth of the scene"
    if rotation > settings.max_rotation_deg:
        return f"turned by {rotation:.1f} degrees"
    if overlap < settings.min_overlap:
        return f"sees {overlap:.0%} of the points of its reference keyframe"
    return ""
