"""Where the camera was last in a world, and what is around it: all that the next frame needs to know."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class TrackingState:
    """The camera's way through a map, up to the last frame.

    T_cr:            (4, 4) the last frame from its reference keyframe, so that it moves with the map
    reference:       row of that keyframe
    reference_size:  points of the reference keyframe that other keyframes see too
    velocity:        (4, 4) last motion, T_c_previous; None where it is unknown
    seen_last:       (n,) points that the last frame saw
    local_keyframes: (k,) the reference keyframe and those that share most points with it
    local_points:    (m,) what these see
    error:           median squared error of the matches in units of their variance, over the last frames
    explained:       share of the image with keypoints in which some agree with the map, over the last frames
    """

    T_cr: Tensor
    reference: int
    reference_size: int
    velocity: Tensor | None
    seen_last: Tensor
    local_keyframes: Tensor
    local_points: Tensor
    error: float = 0.0
    explained: float = 1.0

    @classmethod
    def nowhere(cls, like: Tensor) -> TrackingState:
        """Before there is a keyframe to follow; device and floating-point type of `like`."""
        nobody = torch.empty(0, dtype=torch.int64, device=like.device)
        eye = torch.eye(4, dtype=like.dtype, device=like.device)
        return cls(eye, -1, 0, None, nobody, nobody, nobody)
