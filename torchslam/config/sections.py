"""The sections of a configuration: every setting with its default, description and allowed values."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchslam.config.schema import Settings, setting
from torchslam.plugins import FEATURE_EXTRACTORS, MATCHERS, MOTION_MODELS

MAX_NUMBER = 1_000_000
"""Upper bound of counts, ratios and factors without a natural limit; far beyond the value that disables a test."""
MAX_KEYPOINTS = 1 << 13
"""Upper bound of the keypoints of an image: the memory of comparing all with all grows with its square."""
MAX_READOUT_MS = 1000
"""Bound of the readout of a rolling shutter and of its error, milliseconds: cameras need 5 to 60."""
MAX_PIXELS = 1 << 26
"""Number of pixels of the largest image that is decoded."""
REDUCTION_TOLERANCE = 1.6
"""Images are reduced only if they have more than this multiple of `features.max_image_pixels`."""


@dataclass(frozen=True)
class CameraConfig(Settings, section="camera"):
    """The given camera, which the final bundle adjustment uses as a prior.

    Attributes:
        std: Relative standard deviation of the given focal length and radial distortion; 0: the camera is exact.
        guessed: The focal length is a guess: no map is made of what a rotation with another one explains as well.
        readout: Given time from the exposure of the first row of an image to the last, in milliseconds: that of a
            rolling shutter.
        readout_std: Standard deviation of the readout, in milliseconds: images say more about it; a readout of 0 is
            replaced only where they show a rolling shutter. 0: the readout is exact.
    """

    std: float = setting(0.02, high=1)
    guessed: bool = False
    readout: float = setting(0.0, low=-MAX_READOUT_MS, high=MAX_READOUT_MS)
    readout_std: float = setting(float(MAX_READOUT_MS), high=MAX_READOUT_MS)


@dataclass(frozen=True)
class FeaturesConfig(Settings, section="features"):
    """Keypoint detection and description.

    Attributes:
        kind: Feature extractor that detects and describes keypoints.
        num_keypoints: Maximum number of keypoints per image. More for images of weak texture, or where tracking is
            lost; the time of a frame grows with it.
        max_image_pixels: Number of pixels to which much larger images are reduced before extraction; 0 disables the
            reduction.
        weights: Weights of a learned feature extractor: a file, or the name of published ones; empty: those of its own
            name.
    """

    kind: str = setting(
        "orb", choices=("orb", "opencv-orb", "sift", "simulated", "xfeat", "aliked"), group=FEATURE_EXTRACTORS
    )
    num_keypoints: int = setting(1000, low=1, high=MAX_KEYPOINTS)
    max_image_pixels: int = setting(640 * 480, low=32 * 32, high=MAX_PIXELS, also=0)
    weights: str = ""

    def reduction(self, size: tuple[int, int]) -> float:
        """The factor, at least 1, by which the width and height of images (width, height) are reduced."""
        pixels = size[0] * size[1]
        limit = self.max_image_pixels
        if self.kind == "simulated" or limit == 0 or pixels <= REDUCTION_TOLERANCE * limit:
            return 1.0
        return math.sqrt(pixels / limit)


@dataclass(frozen=True)
class SimulatedConfig(Settings, section="simulated"):
    """Scene points that are projected into the frames in place of features, to test the geometry without images.

    Attributes:
        points_per_view: Number of points scattered in each sampled view.
        depth_near: Depth of the nearest point as a ratio of the extent of the trajectory.
        depth_far: Depth of the farthest point as a ratio of the extent of the trajectory.
        noise_px: Standard deviation of the keypoint positions, in pixels.
        outlier_ratio: Ratio of the keypoints that are placed at random positions.
        with_scales: Give points a size, so that keypoint scales depend on depth and noise grows with the scale.
    """

    points_per_view: int = setting(400, low=1, high=100_000)
    depth_near: float = setting(0.1, above=0, high=MAX_NUMBER)
    depth_far: float = setting(1.0, above=0, high=MAX_NUMBER)
    noise_px: float = setting(0.0, high=10_000)
    outlier_ratio: float = setting(0.0, high=1)
    with_scales: bool = False


@dataclass(frozen=True)
class MatchingConfig(Settings, section="matching"):
    """Matching of descriptors. A feature extractor of your own may need other limits, since they depend on it.

    Attributes:
        max_hamming_distance: Maximum Hamming distance between binary descriptors, in bits.
        max_cosine_distance: Maximum cosine distance (1 - cosine) between floating-point descriptors.
        max_ratio: Maximum ratio of the best to the second-best descriptor distance.
        matcher: Matcher for two views and for map points against a view; descriptors: mutual nearest neighbors.
        weights: Weights of a learned matcher: a file, or the name of published ones; empty: those for the features.
    """

    max_hamming_distance: float = setting(64.0, above=0, high=4096)
    max_cosine_distance: float = setting(0.25, above=0, high=2)
    max_ratio: float = setting(0.8, above=0, high=1)
    matcher: str = setting("descriptors", choices=("descriptors", "lightglue"), group=MATCHERS)
    weights: str = ""


@dataclass(frozen=True)
class InitializationConfig(Settings, section="initialization"):
    """Two-view initialization of a map.

    Attributes:
        min_matches: Minimum number of matches with the reference frame; the initial map needs points for 60 % of this
            number. Fewer for images of weak texture, or for a feature extractor with few keypoints.
        min_planar_frames: Number of frames that must look planar before a planar scene is accepted. Fewer for clips of
            a few frames, as in training.
    """

    min_matches: int = setting(100, low=1, high=MAX_NUMBER)
    min_planar_frames: int = setting(10, high=MAX_NUMBER)


@dataclass(frozen=True)
class TrackingConfig(Settings, section="tracking"):
    """Tracking of frames in the map.

    Attributes:
        motion_model: Model that predicts the pose of a frame from those before it.
    """

    motion_model: str = setting(
        "constant-velocity", choices=("constant-velocity", "constant-pose"), group=MOTION_MODELS
    )


@dataclass(frozen=True)
class KeyframesConfig(Settings, section="keyframes"):
    """Keyframe selection: smaller limits give a denser map, which takes longer.

    Attributes:
        max_translation: Translation from the nearest keyframe, relative to the median depth of the tracked points,
            beyond which a frame becomes a keyframe.
        max_rotation_deg: Rotation from the nearest keyframe, in degrees, beyond which a frame becomes a keyframe.
        min_overlap: Ratio of the tracked points to the well-observed points of the reference keyframe, below which a
            frame becomes a keyframe.
    """

    max_translation: float = setting(0.10, high=MAX_NUMBER)
    max_rotation_deg: float = setting(12.0, high=180)
    min_overlap: float = setting(0.8, high=1)


@dataclass(frozen=True)
class LoopClosingConfig(Settings, section="loop_closing"):
    """Loop closing within a submap and merging of submaps that share a place.

    Attributes:
        enabled: Detect and close loops. Off for odometry only, or where different places look alike.
    """

    enabled: bool = True


@dataclass(frozen=True)
class PaperConfig(Settings, section="paper"):
    """Parts of the system that configs/paper.toml reproduces; each alone shows what the default gains over it.

    Attributes:
        parallax: Initialize by 40 points with a parallax of 3 degrees and a mean of 5, instead of by certain depths.
        brute_force: Track by brute-force matching with the points of the last 60 frames, without motion model and
            projection.
        last_keyframe: Triangulate new points against the last keyframe only; neither fuse nor cull anything.
        unrefined: No bundle adjustment, local or global.
    """

    parallax: bool = False
    brute_force: bool = False
    last_keyframe: bool = False
    unrefined: bool = False


@dataclass(frozen=True)
class GlobalMappingConfig(Settings, section="global_mapping"):
    """Mapping of a whole recording, in no order of time.

    Attributes:
        num_keypoints: Maximum number of keypoints per image, in place of `features.num_keypoints`.
        max_image_pixels: Number of pixels to which much larger images are reduced, in place of
            `features.max_image_pixels`.
        window_images: Number of images that are mapped together; more are mapped in windows that overlap, and joined.
            Memory and time of a window grow with it.
        learned_links: Connect images that too few SIFT tracks connect by XFeat and LightGlue. Requires their weights:
            `torchslam download xfeat-lighterglue`.
    """

    num_keypoints: int = setting(3000, low=1, high=MAX_KEYPOINTS)
    max_image_pixels: int = setting(1_000_000, low=32 * 32, high=MAX_PIXELS, also=0)
    window_images: int = setting(300, low=3, high=MAX_NUMBER)
    learned_links: bool = False


@dataclass(frozen=True)
class DenseConfig(Settings, section="dense"):
    """Dense depth by `torchslam densify` and `torchslam run --dense`.

    Attributes:
        aggregation: Aggregation of matching costs; learned: a small network rates what the classical one found.
    """

    aggregation: str = setting("classical", choices=("classical", "learned"))


@dataclass(frozen=True)
class MetricConfig(Settings, section="metric"):
    """What is known of the unit of the map; each setting is an option of the command line as well.

    Attributes:
        own: Use the measurements that a dataset brings along, such as those of an inertial sensor.
        marker: Printed markers in view and the length of their black squares in meters: apriltag-25h9:0.05,
            aruco-4x4:0.05, charuco-7x5:0.04:0.03 or chessboard-7x5:0.04; with ,7=0.1 markers of the id 7 have another
            length.
        distance: A known length: two image points, each as FRAME:X,Y, and the meters between them in the scene.
        camera_height: Height of the camera above the ground that it moves over, in meters; 0: unknown.
        gps: Positions on the Earth: DJI's .srt, .gpx, .nmea, .csv with the columns time or name, latitude, longitude
            and altitude, KITTI's oxts, or a folder of images whose EXIF blocks have them.
        gps_clock: The clock of those positions: seconds to add to their times to get those of the images, or the date
            and time of the first image, such as 2024-05-01T10:00:00Z. Default: the same, with a difference that is
            found.
        speed: Speeds along the path, as of a wheel encoder: .csv with the columns time and speed, meters per second.
        speed_clock: The clock of those speeds, as --gps-clock.
        odometry: Poses of another sensor in meters, as of wheels: a trajectory in TUM format, in a frame of its own.
        odometry_clock: The clock of that odometry, as --gps-clock.
        imu: Samples of an inertial sensor that moves with the camera: EuRoC's imu0, or a CSV whose header names time,
            gyro_x to gyro_z and acc_x to acc_z with their units, as in `gyro_x [deg/s]`.
        imu_camera: How that sensor is mounted on the camera: Kalibr's camchain-imucam, EuRoC's sensor.yaml of the
            camera, or ORB-SLAM3's settings. Without it, the rotation between the two is found.
        depth: Depth images, 16 bits or floats, taken with the images: a folder or TUM's depth.txt, and after a colon
            the units per meter if they are not those of the dataset or 1000; auto: those that the dataset has.
        depth_camera: The camera of those depth images, as --camera; without it they are registered to the color images.
    """

    own: bool = True
    marker: str = ""
    distance: str = ""
    camera_height: float = setting(0.0, high=MAX_NUMBER)
    gps: str = ""
    gps_clock: str = ""
    speed: str = ""
    speed_clock: str = ""
    odometry: str = ""
    odometry_clock: str = ""
    imu: str = ""
    imu_camera: str = ""
    depth: str = ""
    depth_camera: str = ""
