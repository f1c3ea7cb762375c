"""What leaves the map."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchslam.world.world import World


def drop_covered(world: World, covers: Callable[[Tensor], Tensor]) -> None:
    """Forget what the keyframes around the camera saw at pixels that do not belong to the scene.

    covers: (n, 2) pixels -> (n,) bool
    """
    slam_map = world.map
    seen = slam_map.observations(torch.sort(world.track.local_keyframes).values)
    wrong = covers(seen.pixels)
    slam_map.forget(seen.keyframe_index[wrong], seen.keypoint_index[wrong])
    touched = torch.unique(seen.point_index[wrong])
    slam_map.kill(touched[slam_map.points["times_observed"][touched] < 2])
