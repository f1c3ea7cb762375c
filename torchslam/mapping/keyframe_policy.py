"""When is a frame worth keeping?"""

from __future__ import annotations

import torch

from torchslam.config import KeyframesConfig
from torchslam.geometry.motion import apart
from torchslam.map.submap import Submap
from torchslam.types import FrameFeatures, PoseEstimate

ENOUGH_OVERLAP = 0.4
"""Above it a keyframe is put off for as many frames as a live camera is ahead, since what waits too long is dropped;
half of the default `min_overlap`, so that tracking stays safe."""


def why_keyframe(view: FrameFeatures, tracked: PoseEstimate, world: Submap, settings: KeyframesConfig) -> str:
    """Why a tracked frame should become a keyframe, in words; empty when it should not.

    Because no keyframe around is near it, in translation (as a share of the depth of the scene) and in rotation; or
    because it sees few of the points of its reference keyframe, the one that shares most points with it.
    """
    slam_map, track = world.map, world.track
    newest = slam_map.num_keyframes - 1
    age = abs(view.index - int(slam_map.keyframes["frame_index"][newest]))
    overlap = tracked.inliers / max(track.reference_size, 1)
    if age < max(1, settings.min_interval) or (age < view.waiting and overlap > ENOUGH_OVERLAP):
        return ""
    around = torch.cat([track.local_keyframes, track.local_keyframes.new_tensor([newest])])
    translation, rotation = apart(tracked.T_cw, slam_map.T_cw[around], tracked.depth)
    has_moved, has_turned = translation > settings.max_translation, rotation > settings.max_rotation_deg
    if bool((has_moved | has_turned).all()):
        if bool(has_moved.all()):
            return f"moved by {float(translation.min()):.2f} of the depth of the scene"
        return f"turned by {float(rotation[~has_moved].min()):.1f} degrees"
    if overlap < settings.min_overlap:
        return f"sees {overlap:.0%} of the points of its reference keyframe"
    return ""
