"""Settings of the filters for image content that is not part of the static scene."""

from __future__ import annotations

from dataclasses import dataclass

from torchslam.config.limits import MAX_COUNT, MAX_FACTOR, MAX_LENGTH_PX
from torchslam.config.schema import Settings, setting


@dataclass(frozen=True)
class StaticOverlayConfig(Settings, section="static_overlay"):
    """Detection of pixels that stay in place while the scene moves, such as logos and dirt on the lens."""

    enabled: bool = setting(True, "Detect static overlays.")
    min_motion_px: float = setting(
        4.0,
        "Minimum image motion, in pixels, that a scene point must have had between the compared frames.",
        above=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    min_moving_ratio: float = setting(
        0.5, "Minimum ratio of keypoints that must have moved before two frames are compared.", low=0, high=1
    )
    radius_px: float = setting(
        1.5,
        "Radius, in pixels, within which a keypoint counts as not having moved.",
        above=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    cell_px: float = setting(
        4.0,
        "Size, in pixels, of the cells that accumulate evidence; corners move slightly under noise.",
        above=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    max_distance_ratio: float = setting(
        0.6,
        "Maximum descriptor distance as a ratio of the limit of ordinary matching.",
        above=0,
        high=1,
    )
    min_keypoints: int = setting(
        8, "Minimum number of static keypoints; fewer are considered a coincidence.", low=1, high=MAX_COUNT
    )
    min_evidence: int = setting(
        2,
        "Number of comparisons in which a cell must have been static before it is masked.",
        low=1,
        high=MAX_COUNT,
    )


@dataclass(frozen=True)
class IndependentMotionConfig(Settings, section="independent_motion"):
    """Detection of image regions that move relative to the scene, such as people and cars."""

    enabled: bool = setting(True, "Detect independently moving objects.")
    frame_interval: int = setting(5, "Number of frames between two comparisons.", low=1, high=MAX_COUNT)
    min_error_px: float = setting(
        4.0,
        "Minimum distance, in pixels, of a match from every position that a static point could have.",
        above=0,
        high=MAX_LENGTH_PX,
    )
    threshold_px: float = setting(
        2.0,
        "Inlier threshold, in pixels, of the motion shared by an object's matches.",
        above=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    search_px: float = setting(
        16.0,
        "Search radius, in pixels, around the position predicted by the object's last motion.",
        above=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    min_matches: int = setting(20, "Minimum number of matches that share a motion.", low=5, high=MAX_COUNT)
    min_outlier_ratio: float = setting(
        0.5,
        "Minimum ratio of the matches inconsistent with the scene that must share the motion.",
        low=0,
        high=1,
    )
    max_area_ratio: float = setting(
        2.0,
        "Maximum image area of the object as a multiple of the area that agrees with the map.",
        above=0,
        high=MAX_FACTOR,
    )
    max_unseen_frames: int = setting(
        150,
        "Number of frames for which an object is tracked without being observed to move.",
        low=1,
        high=MAX_COUNT,
    )
