"""Settings of map initialization, tracking, pose validation and relocalization."""

from __future__ import annotations

from dataclasses import dataclass

from torchslam.config.limits import MAX_COUNT, MAX_FACTOR, MAX_LENGTH_PX
from torchslam.config.schema import Settings, setting


@dataclass(frozen=True)
class InitializationConfig(Settings, section="initialization"):
    """Two-view initialization of a map."""

    criterion: str = setting(
        "uncertainty",
        "Criterion by which a point of the initial map counts as good; configs/paper.toml uses the parallax.",
        choices=("uncertainty", "parallax"),
    )
    min_matches: int = setting(
        100,
        "Minimum number of matches with the reference frame; with fewer, the reference is replaced.",
        low=1,
        high=MAX_COUNT,
    )
    min_motion_px: float = setting(
        2.0,
        "Minimum median motion of the matches, in pixels; below it the camera is considered stationary.",
        low=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    max_static_px: float = setting(
        1.0,
        "Maximum motion, in pixels, of a match that is considered static.",
        above=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    min_points: int = setting(60, "Minimum number of points of the initial map.", low=1, high=MAX_COUNT)
    threshold_px: float = setting(
        1.5,
        "Inlier threshold of the essential-matrix and homography RANSAC, in pixels.",
        above=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    max_depth_std: float = setting(
        0.1,
        "Maximum relative standard deviation of the depth of a good point (criterion uncertainty).",
        above=0,
        high=MAX_FACTOR,
    )
    min_good_ratio: float = setting(
        0.15, "Minimum ratio of good points to matches (criterion uncertainty).", low=0, high=1
    )
    min_planar_frames: int = setting(
        10,
        "Number of frames that must look planar before a planar scene is accepted.",
        low=0,
        high=MAX_COUNT,
    )
    min_planar_ratio: float = setting(
        0.5,
        "Minimum ratio of good points to matches in a planar scene (criterion uncertainty).",
        low=0,
        high=1,
    )
    min_parallax_deg: float = setting(
        3.0, "Minimum parallax of a good point, in degrees (criterion parallax).", low=0, high=180
    )
    min_mean_parallax_deg: float = setting(
        5.0,
        "Minimum mean parallax of the initial map, in degrees (criterion parallax).",
        low=0,
        high=180,
    )
    min_explained_ratio: float = setting(
        0.8,
        "Minimum ratio of the frames since the reference frame that can be localized in the initial map.",
        low=0,
        high=1,
    )
    max_reference_age: int = setting(
        300, "Number of frames after which the reference frame is replaced.", low=2, high=MAX_COUNT
    )
    max_unposed_frames: int = setting(
        1000,
        "Maximum number of frames without a pose that are kept and posed once there is a map.",
        low=0,
        high=100_000,
    )
    provisional_frames: int = setting(
        20,
        "Number of tracked frames after which a new map is no longer discarded when tracking is lost.",
        low=0,
        high=MAX_COUNT,
    )


@dataclass(frozen=True)
class TrackingConfig(Settings, section="tracking"):
    """Tracking of a frame in the local map."""

    motion_model: bool = setting(
        True,
        "Predict the pose with a constant-velocity model; otherwise the previous pose is the prediction.",
    )
    guided_matching: bool = setting(
        True, "Match by projection before brute force; otherwise brute force only."
    )
    search_radius_px: float = setting(
        12.0,
        "Search radius around a projected point, in pixels of the finest pyramid level.",
        above=0,
        high=MAX_LENGTH_PX,
    )
    wide_radius_factor: float = setting(
        3.0,
        "Factor of the search radius in the second search, made if the first has too few matches.",
        low=1,
        high=100,
    )
    refine_radius_px: float = setting(
        5.0,
        "Search radius around points projected with the estimated pose, in pixels.",
        above=0,
        high=MAX_LENGTH_PX,
    )
    threshold_px: float = setting(
        3.0,
        "Inlier threshold of the absolute pose, in pixels.",
        above=0,
        grows=True,
        high=MAX_LENGTH_PX,
    )
    min_matches: int = setting(
        20, "Minimum number of guided matches; with fewer, brute force is used.", low=1, high=MAX_COUNT
    )
    min_inliers: int = setting(
        20, "Minimum number of inliers; with fewer, tracking is lost.", low=1, high=MAX_COUNT
    )
    local_keyframes: int = setting(
        12, "Number of keyframes that make up the local map.", low=1, high=MAX_COUNT
    )
    max_view_angle_deg: float = setting(
        60.0,
        "Maximum angle, in degrees, between the current and the last viewing direction of a point.",
        above=0,
        high=180,
    )
    recent_frames: int = setting(
        0,
        "Number of recent frames whose points are matched instead of the local map; 0 uses the local map.",
        low=0,
        high=MAX_COUNT,
    )


@dataclass(frozen=True)
class PoseValidationConfig(Settings, section="pose_validation"):
    """Validation of a pose; mapping from an uncertain one stays tentative until later frames confirm it."""

    min_inlier_ratio: float = setting(
        0.5, "Minimum ratio of inliers to matches around the predicted pixels.", low=0, high=1
    )
    max_squared_error: float = setting(
        1.3,
        "Maximum median squared error in units of the noise, averaged over ten frames.",
        above=0,
        high=MAX_FACTOR,
    )
    min_explained_ratio: float = setting(
        0.3,
        "Minimum ratio of the image area with keypoints that the map explains, averaged over ten frames.",
        low=0,
        high=1,
    )
    min_coverage_ratio: float = setting(
        0.2,
        "Minimum ratio of the image area covered by inliers where map points are expected.",
        low=0,
        high=1,
    )
    max_position_std: float = setting(
        0.017,
        "Maximum standard deviation of the position as a ratio of the median depth of the tracked points.",
        above=0,
        high=MAX_FACTOR,
    )
    max_rotation_std_deg: float = setting(
        0.9, "Maximum standard deviation of the rotation, in degrees.", above=0, high=180
    )
    max_jump: float = setting(
        0.5,
        "Maximum distance from the predicted position as a ratio of the median depth.",
        above=0,
        high=MAX_FACTOR,
    )
    max_turn_deg: float = setting(
        20.0, "Maximum rotation from the predicted orientation, in degrees.", above=0, high=180
    )
    num_confirming_frames: int = setting(
        2,
        "Number of consecutive valid frames that confirm an uncertain pose.",
        low=1,
        high=MAX_COUNT,
    )


@dataclass(frozen=True)
class RelocalizationConfig(Settings, section="relocalization"):
    """Relocalization after tracking was lost."""

    max_candidates: int = setting(
        3, "Maximum number of candidate keyframes per frame.", low=1, high=MAX_COUNT
    )
    num_confirming_frames: int = setting(
        4,
        "Number of consecutive valid frames after a relocalization before mapping resumes.",
        low=1,
        high=MAX_COUNT,
    )
    frames_before_new_submap: int = setting(
        20, "Number of lost frames before a new submap may be initialized.", low=0, high=MAX_COUNT
    )
