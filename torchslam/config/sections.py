"""The sections of a configuration: every setting with its default, description and allowed values."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchslam.config.schema import Settings, setting
from torchslam.plugins import FEATURE_EXTRACTORS, MATCHERS

MAX_COUNT = 1_000_000
"""Upper bound of every count: frames, keyframes, points or matches."""
MAX_LENGTH_PX = 10_000
"""Upper bound of every length in the image; no image is larger."""
MAX_KEYPOINTS = 1 << 13
"""Upper bound of the keypoints of an image: the memory of comparing all with all grows with its square."""
MAX_ITERATIONS = 1000
"""Upper bound of the iterations of an adjustment; after a hundred nothing changes any more."""
MIN_CELL_PX = 1.0
"""Lower bound of the cells of a grid over the image, whose memory grows with their number."""
MAX_FACTOR = 1_000_000
"""Upper bound of ratios and factors without a natural limit; far beyond the value that disables a test."""

MAX_READOUT_MS = 1000
"""Bound of the readout of a rolling shutter and of its error, milliseconds: cameras need 5 to 60."""

MAX_PIXELS = 1 << 26
"""Number of pixels of the largest image that is decoded."""
REDUCTION_TOLERANCE = 1.6
"""Images are reduced only if they have more than this multiple of `features.max_image_pixels`."""


@dataclass(frozen=True)
class CameraConfig(Settings, section="camera"):
    """The given camera, which the final bundle adjustment uses as a prior."""

    std: float = setting(
        0.02,
        "Relative standard deviation of the given focal length and radial distortion; 0: the camera is exact.",
        low=0,
        high=1,
    )
    guessed: bool = setting(
        False,
        "The focal length is a guess: no map is made of what a rotation with another one explains as well.",
    )
    readout: float = setting(
        0.0,
        "Given time from the exposure of the first row of an image to the last, in milliseconds: that of a rolling "
        "shutter.",
        low=-MAX_READOUT_MS,
        high=MAX_READOUT_MS,
    )
    readout_std: float = setting(
        float(MAX_READOUT_MS),
        "Standard deviation of the readout, in milliseconds: images say more about it; a readout of 0 is replaced only "
        "where they show a rolling shutter. 0: the readout is exact.",
        low=0,
        high=MAX_READOUT_MS,
    )


@dataclass(frozen=True)
class FeaturesConfig(Settings, section="features"):
    """Keypoint detection and description."""

    kind: str = setting(
        "orb",
        "Feature extractor that detects and describes keypoints.",
        choices=("orb", "opencv-orb", "sift", "simulated", "xfeat", "aliked"),
        group=FEATURE_EXTRACTORS,
    )
    num_keypoints: int = setting(1000, "Maximum number of keypoints per image.", low=1, high=MAX_KEYPOINTS)
    max_image_pixels: int = setting(
        640 * 480,
        "Number of pixels to which much larger images are reduced before extraction; 0 disables the reduction.",
        low=32 * 32,
        high=MAX_PIXELS,
        also=0,
    )
    weights: str = setting(
        "",
        "Weights of a learned feature extractor: a file, or the name of published ones; empty: those of its own name.",
    )

    def reduction(self, size: tuple[int, int]) -> float:
        """The factor, at least 1, by which the width and height of images (width, height) are reduced."""
        pixels = size[0] * size[1]
        limit = self.max_image_pixels
        if self.kind == "simulated" or limit == 0 or pixels <= REDUCTION_TOLERANCE * limit:
            return 1.0
        return math.sqrt(pixels / limit)


@dataclass(frozen=True)
class SimulatedConfig(Settings, section="simulated"):
    """Simulated features: scene points scattered along the true trajectory and projected into the frames."""

    points_per_view: int = setting(
        400, "Number of points scattered in each sampled view.", low=1, high=100_000
    )
    depth_near: float = setting(
        0.1,
        "Depth of the nearest point as a ratio of the extent of the trajectory.",
        above=0,
        high=MAX_FACTOR,
    )
    depth_far: float = setting(
        1.0,
        "Depth of the farthest point as a ratio of the extent of the trajectory.",
        above=0,
        high=MAX_FACTOR,
    )
    noise_px: float = setting(
        0.0, "Standard deviation of the keypoint positions, in pixels.", low=0, high=MAX_LENGTH_PX
    )
    outlier_ratio: float = setting(
        0.0, "Ratio of the keypoints that are placed at random positions.", low=0, high=1
    )
    dropout_ratio: float = setting(
        0.0, "Ratio of the visible points that are missing from a frame.", low=0, high=1
    )
    with_scales: bool = setting(
        False, "Give points a size, so that keypoint scales depend on depth and noise grows with the scale."
    )


@dataclass(frozen=True)
class MatchingConfig(Settings, section="matching"):
    """Descriptor matching."""

    max_hamming_distance: float = setting(
        64.0, "Maximum Hamming distance between binary descriptors, in bits.", above=0, high=4096
    )
    max_cosine_distance: float = setting(
        0.25, "Maximum cosine distance (1 - cosine) between floating-point descriptors.", above=0, high=2
    )
    max_ratio: float = setting(
        0.8, "Maximum ratio of the best to the second-best descriptor distance.", above=0, high=1
    )
    matcher: str = setting(
        "descriptors",
        "Matcher for two views and for map points against a view; descriptors: mutual nearest neighbors.",
        choices=("descriptors", "lightglue"),
        group=MATCHERS,
    )
    weights: str = setting(
        "",
        "Weights of a learned matcher: a file, or the name of published ones; empty: those for the features.",
    )


@dataclass(frozen=True)
class MeasurementConfig(Settings, section="measurement"):
    """Inlier test of tracking, mapping and bundle adjustment: distance of a keypoint from its prediction."""

    max_chi_square: float = setting(
        5.991,
        "Maximum squared error in units of the noise; the default is the 95 % quantile for two degrees of freedom.",
        above=0,
        high=MAX_FACTOR,
    )


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
        low=MIN_CELL_PX,
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


@dataclass(frozen=True)
class KeyframesConfig(Settings, section="keyframes"):
    """Keyframe selection: a frame that exceeds one of the limits becomes a keyframe."""

    max_translation: float = setting(
        0.10,
        "Maximum translation from the reference keyframe as a ratio of the median depth of the tracked points.",
        low=0,
        high=MAX_FACTOR,
    )
    max_rotation_deg: float = setting(
        12.0, "Maximum rotation from the reference keyframe, in degrees.", low=0, high=180
    )
    min_overlap: float = setting(
        0.8,
        "Minimum ratio of the tracked points to the well-observed points of the reference keyframe.",
        low=0,
        high=1,
    )
    min_points: int = setting(
        80, "Minimum number of tracked points; fewer will soon be too few.", low=0, high=MAX_COUNT
    )
    min_interval: int = setting(0, "Minimum number of frames between two keyframes.", low=0, high=MAX_COUNT)


@dataclass(frozen=True)
class MappingConfig(Settings, section="mapping"):
    """Local mapping: triangulation, fusion and culling of map points."""

    triangulation_partners: str = setting(
        "covisible",
        "Keyframes against which new points are triangulated.",
        choices=("covisible", "last"),
    )
    num_partners: int = setting(5, "Number of triangulation partners.", low=1, high=MAX_COUNT)
    min_parallax_deg: float = setting(1.0, "Minimum parallax of a new point, in degrees.", low=0, high=180)
    max_epipolar_px: float = setting(
        2.0,
        "Maximum distance of a match from its epipolar line, in pixels.",
        above=0,
        high=MAX_LENGTH_PX,
    )
    min_baseline: float = setting(
        0.01, "Minimum baseline as a ratio of the median depth.", low=0, high=MAX_FACTOR
    )
    fuse: bool = setting(True, "Fuse duplicate points.")
    cull: bool = setting(True, "Remove points that are rarely found again.")
    min_found_ratio: float = setting(
        0.25,
        "Minimum ratio of the frames that found a point to those in which it was visible.",
        low=0,
        high=1,
    )


@dataclass(frozen=True)
class LoopClosingConfig(Settings, section="loop_closing"):
    """Loop closing within a submap and merging of submaps that share a place."""

    enabled: bool = setting(True, "Detect and close loops.")
    max_candidates: int = setting(
        3, "Maximum number of loop candidates verified per keyframe.", low=1, high=MAX_COUNT
    )
    min_matches: int = setting(
        40,
        "Minimum number of points of the candidate's map that the keyframe must observe.",
        low=6,
        high=MAX_COUNT,
    )
    min_sim3_points: int = setting(
        20,
        "Minimum number of point pairs, known to both maps, for the Sim(3) estimate.",
        low=3,
        high=MAX_COUNT,
    )
    min_confirming_keyframes: int = setting(
        2,
        "Minimum number of covisible keyframes that must observe the candidate's place as well.",
        low=0,
        high=MAX_COUNT,
    )
    max_drift: float = setting(
        0.2,
        "Maximum plausible drift of the position as a ratio of the distance traveled since the candidate.",
        above=0,
        high=MAX_FACTOR,
    )
    max_drift_deg: float = setting(
        20.0, "Maximum plausible drift of the rotation, in degrees.", above=0, high=180
    )
    max_drift_scale: float = setting(
        5.0, "Maximum plausible drift of the scale, as a factor.", low=1, high=MAX_FACTOR
    )
    global_bundle_adjustment: bool = setting(
        True, "Run a global bundle adjustment after a loop was closed or submaps were merged."
    )


@dataclass(frozen=True)
class BundleAdjustmentConfig(Settings, section="bundle_adjustment"):
    """Local bundle adjustment after each keyframe and global bundle adjustment at the end of a run."""

    local: bool = setting(
        True, "Run a local bundle adjustment of the newest keyframes and their points after each keyframe."
    )
    local_window: int = setting(
        8, "Number of keyframes with free poses in the local bundle adjustment.", low=2, high=MAX_COUNT
    )
    max_fixed_keyframes: int = setting(
        12, "Maximum number of fixed keyframes in the local bundle adjustment.", low=1, high=MAX_COUNT
    )
    local_iterations: int = setting(
        6, "Maximum number of iterations of the local bundle adjustment.", low=1, high=MAX_ITERATIONS
    )
    delay_frames: int = setting(
        2,
        "Number of frames tracked before the result of a local bundle adjustment is applied; "
        "a worker process can compute it meanwhile.",
        low=0,
        high=MAX_COUNT,
    )
    global_at_end: bool = setting(True, "Run a global bundle adjustment at the end of the run.")
    global_iterations: int = setting(
        15, "Maximum number of iterations of a global bundle adjustment.", low=1, high=MAX_ITERATIONS
    )


@dataclass(frozen=True)
class GlobalMappingConfig(Settings, section="global_mapping"):
    """Mapping of a whole recording, in no order of time."""

    num_keypoints: int = setting(
        3000,
        "Maximum number of keypoints per image, in place of `features.num_keypoints`.",
        low=1,
        high=MAX_KEYPOINTS,
    )
    max_image_pixels: int = setting(
        1_000_000,
        "Number of pixels to which much larger images are reduced, in place of `features.max_image_pixels`.",
        low=32 * 32,
        high=MAX_PIXELS,
        also=0,
    )
    max_images: int = setting(
        300,
        "Number of images that are spread evenly over the recording; frames between them are posed afterwards.",
        low=3,
        high=MAX_COUNT,
    )
    learned_links: bool = setting(
        False,
        "Connect images that too few SIFT tracks connect by XFeat and LightGlue. Requires their weights: "
        "`torchslam download xfeat-lighterglue`.",
    )


@dataclass(frozen=True)
class DenseConfig(Settings, section="dense"):
    """Dense depth by `torchslam densify` and `torchslam run --dense`."""

    aggregation: str = setting(
        "classical",
        "Aggregation of matching costs; learned: a small network rates what the classical one found.",
        choices=("classical", "learned"),
    )


@dataclass(frozen=True)
class MetricConfig(Settings, section="metric"):
    """What is known of the unit of the map; each setting is an option of the command line as well."""

    own: bool = setting(
        True, "Use the measurements that a dataset brings along, such as those of an inertial sensor."
    )
    marker: str = setting(
        "",
        "Printed markers in view and the length of their black squares in meters: apriltag-25h9:0.05, aruco-4x4:0.05, "
        "charuco-7x5:0.04:0.03 or chessboard-7x5:0.04; with ,7=0.1 markers of the id 7 have another length.",
    )
    distance: str = setting(
        "", "A known length: two image points, each as FRAME:X,Y, and the meters between them in the scene."
    )
    camera_height: float = setting(
        0.0,
        "Height of the camera above the ground that it moves over, in meters; 0: unknown.",
        low=0,
        high=MAX_FACTOR,
    )
    gps: str = setting(
        "",
        "Positions on the Earth: DJI's .srt, .gpx, .nmea, .csv with the columns time or name, latitude, longitude and "
        "altitude, KITTI's oxts, or a folder of images whose EXIF blocks have them.",
    )
    gps_clock: str = setting(
        "",
        "The clock of those positions: seconds to add to their times to get those of the images, or the date and time "
        "of the first image, such as 2024-05-01T10:00:00Z. Default: the same, with a difference that is found.",
    )
    speed: str = setting(
        "",
        "Speeds along the path, as of a wheel encoder: .csv with the columns time and speed, meters per second.",
    )
    speed_clock: str = setting("", "The clock of those speeds, as --gps-clock.")
    odometry: str = setting(
        "",
        "Poses of another sensor in meters, as of wheels: a trajectory in TUM format, in a frame of its own.",
    )
    odometry_clock: str = setting("", "The clock of that odometry, as --gps-clock.")
    imu: str = setting(
        "",
        "Samples of an inertial sensor that moves with the camera: EuRoC's imu0, or a CSV whose header names time, "
        "gyro_x to gyro_z and acc_x to acc_z with their units, as in `gyro_x [deg/s]`.",
    )
    imu_camera: str = setting(
        "",
        "How that sensor is mounted on the camera: Kalibr's camchain-imucam, EuRoC's sensor.yaml of the camera, or "
        "ORB-SLAM3's settings. Without it, the rotation between the two is found.",
    )
    depth: str = setting(
        "",
        "Depth images of 16 bits that were taken with the images: a folder or TUM's depth.txt, and after a colon the "
        "units per meter if they are not those of the dataset or 1000; auto: those that the dataset has.",
    )
    depth_camera: str = setting(
        "",
        "The camera of those depth images, as --camera; without it they are registered to the color images.",
    )
