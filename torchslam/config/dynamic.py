"""What does not belong to the scene."""

from __future__ import annotations

from dataclasses import dataclass

from torchslam.config.limits import LARGEST, LONGEST_PX, MOST
from torchslam.config.schema import Settings, setting


@dataclass(frozen=True)
class StillnessConfig(Settings, section="stillness"):
    """When pixels stay in place that should have moved with the scene, as logos and dirt on the lens do."""

    enabled: bool = setting(True, "whether such pixels are looked for")
    min_motion_px: float = setting(
        4.0, "a point of the scene would have moved by at least this", above=0, grows=True, high=LONGEST_PX
    )
    min_moving_share: float = setting(0.5, "of the keypoints, before two frames are compared", low=0, high=1)
    radius_px: float = setting(
        1.5, "within which a keypoint has stayed", above=0, grows=True, high=LONGEST_PX
    )
    cell_px: float = setting(
        4.0,
        "of the cells that evidence is kept of: a corner wanders a little under noise",
        above=0,
        grows=True,
        high=LONGEST_PX,
    )
    max_distance_share: float = setting(0.6, "of the distance at which descriptors match", above=0, high=1)
    min_keypoints: int = setting(8, "fewer that stay are chance", low=1, high=MOST)
    min_evidence: int = setting(2, "comparisons in which a pixel stayed", low=1, high=MOST)


@dataclass(frozen=True)
class IndependentMotionConfig(Settings, section="independent_motion"):
    """When a part of the image moves against the scene, as people and cars do."""

    enabled: bool = setting(True, "whether such parts are looked for")
    frames: int = setting(5, "from one comparison to the next", low=1, high=MOST)
    min_error_px: float = setting(
        4.0, "by which a match misses where a point of the scene can be", above=0, high=LONGEST_PX
    )
    threshold_px: float = setting(2.0, "of the motion that they share", above=0, grows=True, high=LONGEST_PX)
    search_px: float = setting(
        16.0,
        "how far a keypoint is looked for from where the last motion took it",
        above=0,
        grows=True,
        high=LONGEST_PX,
    )
    min_matches: int = setting(20, "that share a motion", low=5, high=MOST)
    min_share: float = setting(0.5, "of the matches that miss the scene", low=0, high=1)
    max_share: float = setting(
        2.0, "of the image, as a multiple of what agrees with the map", above=0, high=LARGEST
    )
    max_unseen: int = setting(150, "frames that it is followed without being seen to move", low=1, high=MOST)
