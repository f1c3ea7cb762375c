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
    num_keypoints: int = setting(
        1000,
        "Maximum number of keypoints per image. More for images of weak texture, or where tracking is lost; the time "
        "of a frame grows with it.",
        low=1,
        high=MAX_KEYPOINTS,
    )
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
    """Scene points that are projected into the frames in place of features, to test the geometry without images."""

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
    with_scales: bool = setting(
        False, "Give points a size, so that keypoint scales depend on depth and noise grows with the scale."
    )


@dataclass(frozen=True)
class MatchingConfig(Settings, section="matching"):
    """Matching of descriptors. A feature extractor of your own may need other limits, since they depend on it."""

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
class InitializationConfig(Settings, section="initialization"):
    """Two-view initialization of a map."""

    min_matches: int = setting(
        100,
        "Minimum number of matches with the reference frame; the initial map needs points for 60 % of this number. "
        "Fewer for images of weak texture, or for a feature extractor with few keypoints.",
        low=1,
        high=MAX_COUNT,
    )
    min_planar_frames: int = setting(
        10,
        "Number of frames that must look planar before a planar scene is accepted. Fewer for clips of a few frames, "
        "as in training.",
        low=0,
        high=MAX_COUNT,
    )


@dataclass(frozen=True)
class KeyframesConfig(Settings, section="keyframes"):
    """Keyframe selection: smaller limits give a denser map, which takes longer."""

    max_translation: float = setting(
        0.10,
        "Translation from the nearest keyframe, relative to the median depth of the tracked points, beyond which a "
        "frame becomes a keyframe.",
        low=0,
        high=MAX_FACTOR,
    )
    max_rotation_deg: float = setting(
        12.0,
        "Rotation from the nearest keyframe, in degrees, beyond which a frame becomes a keyframe.",
        low=0,
        high=180,
    )
    min_overlap: float = setting(
        0.8,
        "Ratio of the tracked points to the well-observed points of the reference keyframe, below which a frame "
        "becomes a keyframe.",
        low=0,
        high=1,
    )


@dataclass(frozen=True)
class LoopClosingConfig(Settings, section="loop_closing"):
    """Loop closing within a submap and merging of submaps that share a place."""

    enabled: bool = setting(
        True, "Detect and close loops. Off for odometry only, or where different places look alike."
    )


@dataclass(frozen=True)
class PaperConfig(Settings, section="paper"):
    """Parts of the system that configs/paper.toml reproduces; each alone shows what the default gains over it."""

    parallax: bool = setting(
        False,
        "Initialize by 40 points with a parallax of 3 degrees and a mean of 5, instead of by certain depths.",
    )
    brute_force: bool = setting(
        False,
        "Track by brute-force matching with the points of the last 60 frames, without motion model and projection.",
    )
    last_keyframe: bool = setting(
        False, "Triangulate new points against the last keyframe only; neither fuse nor cull anything."
    )
    unrefined: bool = setting(False, "No bundle adjustment, local or global.")


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
