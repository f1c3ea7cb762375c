"""A keyframe whose mapping is spread over the frames after it, so that no frame has to wait for all of it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Growth:
    """What is left to be done for the newest keyframe, once it and its new points are in the map.

    keyframe:   its row
    neighbours: (k,) rows of the keyframes that shared most points with it when it came, best first
    due:        the last frame that is tracked before the adjustment around it is taken over; None: the next one is not
    is_fused:   whether its points are merged with those of its neighbours, and the adjustment was begun
    """

    keyframe: int
    neighbours: Tensor
    due: int | None
    is_fused: bool = False
