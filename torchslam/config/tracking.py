"""Where the camera is: from the first map on, and after it was lost."""

from __future__ import annotations

from dataclasses import dataclass

from torchslam.config.limits import LARGEST, LONGEST_PX, MOST
from torchslam.config.schema import Settings, setting


@dataclass(frozen=True)
class InitializationConfig(Settings, section="initialization"):
    criterion: str = setting(
        "uncertainty",
        "what makes a point of the start a good one; configs/paper.toml goes by the parallax",
        choices=("uncertainty", "parallax"),
    )
    min_matches: int = setting(
        100, "fewer than this with the reference frame: a new reference", low=1, high=MOST
    )
    min_motion_px: float = setting(
        2.0, "of the matches, in the median; less is a standstill", low=0, grows=True, high=LONGEST_PX
    )
    still_px: float = setting(
        1.0, "matches that moved less stay in place", above=0, grows=True, high=LONGEST_PX
    )
    min_points: int = setting(60, "that the start must have", low=1, high=MOST)
    threshold_px: float = setting(
        1.5, "of the epipolar and homography RANSAC", above=0, grows=True, high=LONGEST_PX
    )
    max_depth_std: float = setting(
        0.1,
        "uncertainty: a point counts when its relative depth is known better than this",
        above=0,
        high=LARGEST,
    )
    min_good_share: float = setting(0.15, "... and this share of the matches must count", low=0, high=1)
    planar_patience: int = setting(10, "frames that look planar before a plane is believed", low=0, high=MOST)
    min_planar_share: float = setting(0.5, "uncertainty: ... of the matches on a plane", low=0, high=1)
    min_parallax_deg: float = setting(3.0, "parallax: a point counts from this angle on", low=0, high=180)
    min_mean_parallax_deg: float = setting(5.0, "parallax: of all points of the start", low=0, high=180)
    min_explained: float = setting(
        0.8, "share of the frames since the reference that the start must explain", low=0, high=1
    )
    max_reference_age: int = setting(300, "frames; an older reference is replaced", low=2, high=MOST)
    max_waiting: int = setting(
        1000, "frames without a pose that are kept, to be posed once there is a map", low=0, high=100_000
    )
    min_frames: int = setting(
        20,
        "a world that was lost before it had tracked this many frames after its start is taken back",
        low=0,
        high=MOST,
    )


@dataclass(frozen=True)
class TrackingConfig(Settings, section="tracking"):
    predict: bool = setting(True, "constant velocity; without it the previous pose")
    guided: bool = setting(True, "match near the projection first; without it brute force alone")
    radius_px: float = setting(
        12.0, "around a projection, at the finest pyramid level", above=0, high=LONGEST_PX
    )
    wide_radius_factor: float = setting(
        3.0, "of the second search, where the first found too little", low=1, high=100
    )
    refine_radius_px: float = setting(
        5.0, "around the projections by the pose that was found", above=0, high=LONGEST_PX
    )
    threshold_px: float = setting(
        3.0, "of the PnP, with RANSAC or without", above=0, grows=True, high=LONGEST_PX
    )
    min_matches: int = setting(20, "fewer: brute force", low=1, high=MOST)
    min_inliers: int = setting(20, "fewer: the frame is lost", low=1, high=MOST)
    local_keyframes: int = setting(12, "whose points are looked for", low=1, high=MOST)
    max_view_angle_deg: float = setting(
        60.0, "between the direction that a point was last seen from and this one", above=0, high=180
    )
    recent_frames: int = setting(
        0,
        "match points seen in the last n frames instead of the co-visible ones; 0: co-visible",
        low=0,
        high=MOST,
    )


@dataclass(frozen=True)
class PatchesConfig(Settings, section="patches"):
    """When a frame is followed by patches of an earlier one, without features of its own."""

    enabled: bool = setting(False, "whether frames are followed")
    count: int = setting(300, "patches that are followed", low=20, high=MOST)
    min_agreeing: int = setting(
        150, "that must agree with the pose: a thin map is in need of every frame", low=20, high=MOST
    )
    min_similarity: float = setting(
        0.8, "normalised cross-correlation of a patch with the earlier frame", low=0, high=1
    )
    min_share: float = setting(0.6, "of the patches, that must agree with the pose", above=0, high=1)
    max_error_growth: float = setting(
        1.3, "median squared error, as a multiple of that in the earlier frame", above=0, high=1e6
    )
    max_frames: int = setting(5, "followed one after the other", low=1, high=MOST)
    overlap_share: float = setting(
        0.8,
        "of the overlap at which a frame becomes a keyframe: patches are lost sooner than matches",
        above=0,
        high=10,
    )
    delay: int = setting(
        0,
        "frames after which is known what came of one with features: it is mapped meanwhile",
        low=0,
        high=64,
    )


@dataclass(frozen=True)
class JudgeConfig(Settings, section="judge"):
    """When a pose is uncertain: what is mapped from it is on trial until later frames confirm it."""

    min_inlier_share: float = setting(0.5, "of the matches around the predicted pixels", low=0, high=1)
    max_error: float = setting(
        1.3, "median squared error in units of the noise, over ten frames", above=0, high=LARGEST
    )
    min_explained: float = setting(
        0.3, "of the image, where it has keypoints: what the map explains, over ten frames", low=0, high=1
    )
    min_coverage: float = setting(0.2, "of the image, where the map expects something", low=0, high=1)
    max_position_std: float = setting(
        0.017,
        "standard deviation of the position as a share of the median depth of the tracked points",
        above=0,
        high=LARGEST,
    )
    max_rotation_std_deg: float = setting(0.9, "standard deviation of the rotation", above=0, high=180)
    max_jump: float = setting(
        0.5, "from the predicted position, as a share of the depth", above=0, high=LARGEST
    )
    max_turn_deg: float = setting(20.0, "from the predicted rotation", above=0, high=180)
    confirmations: int = setting(2, "certain frames in a row after an uncertain one", low=1, high=MOST)


@dataclass(frozen=True)
class RelocalizationConfig(Settings, section="relocalization"):
    """What happens after the camera is lost."""

    tries: int = setting(3, "places compared a frame", low=1, high=MOST)
    confirmations: int = setting(
        4, "certain frames in a row after a relocalised one, before anything is mapped", low=1, high=MOST
    )
    patience: int = setting(20, "lost frames before a new world may begin", low=0, high=MOST)
