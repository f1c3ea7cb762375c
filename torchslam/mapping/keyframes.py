"""When is a frame worth keeping?"""

from __future__ import annotations

import torch

from torchslam.config import KeyframesConfig
from torchslam.geometry.motion import apart
from torchslam.values import Tracked, View
from torchslam.world.world import World

DENSER = 0.8
"""Of the changes that make a keyframe, what suffices where tracking is fragile."""


def why_keyframe(
    view: View, tracked: Tracked, world: World, settings: KeyframesConfig, is_fragile: bool = False
) -> str:
    """Why a tracked frame should become a keyframe, in words; empty when it should not.

    Because no keyframe around is near it, in translation (as a share of the depth of the scene) and in rotation; or
    because it sees few of the points of its reference keyframe, the one that shares most points with it.

    is_fragile: each keyframe is a large part of what the next frames are tracked by: less of a change suffices
    """
    slam_map, track = world.map, world.track
    newest = slam_map.num_keyframes - 1
    age = abs(view.index - int(slam_map.keyframes["frame_index"][newest]))
    if age < max(1, settings.min_interval):
        return ""
    around = torch.cat([track.local_keyframes, track.local_keyframes.new_tensor([newest])])
    translation, rotation = apart(tracked.T_cw, slam_map.T_cw[around], tracked.depth)
    change = DENSER if is_fragile else 1.0
    has_moved = translation > change * settings.max_translation
    has_turned = rotation > change * settings.max_rotation_deg
    overlap = tracked.inliers / max(track.reference_size, 1)
    if bool((has_moved | has_turned).all()):
        if bool(has_moved.all()):
            return f"moved by {float(translation.min()):.2f} of the depth of the scene"
        return f"turned by {float(rotation[~has_moved].min()):.1f} degrees"
    if 1 - overlap > change * (1 - settings.min_overlap):
        return f"sees {overlap:.0%} of the points of its reference keyframe"
    return ""
