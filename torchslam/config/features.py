"""Settings of the front end: features, descriptor matching and the measurement gate."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchslam.config.limits import MAX_FACTOR, MAX_LENGTH_PX
from torchslam.config.schema import Settings, setting
from torchslam.plugins import FRONT_ENDS, MATCHERS

MAX_PIXELS = 1 << 26
"""Number of pixels of the largest image that is decoded."""
REDUCTION_TOLERANCE = 1.6
"""Images are reduced only if they have more than this multiple of `features.max_image_pixels`."""


@dataclass(frozen=True)
class FeaturesConfig(Settings, section="features"):
    """Keypoint detection and description."""

    kind: str = setting(
        "orb",
        "Feature extractor that detects and describes keypoints.",
        choices=("orb", "opencv-orb", "simulated", "xfeat", "aliked"),
        group=FRONT_ENDS,
    )
    num_keypoints: int = setting(1000, "Maximum number of keypoints per image.", low=1, high=100_000)
    max_image_pixels: int = setting(
        640 * 480,
        "Number of pixels to which much larger images are reduced before extraction; 0 disables the reduction.",
        low=32 * 32,
        high=MAX_PIXELS,
        also=0,
    )
    weights: str = setting("", "File with the weights of a learned feature extractor.")

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
    weights: str = setting("", "File with the weights of a learned matcher.")


@dataclass(frozen=True)
class MeasurementConfig(Settings, section="measurement"):
    """Inlier test of tracking, mapping and bundle adjustment: distance of a keypoint from its prediction."""

    gate: str = setting(
        "chi_square",
        "Unit of the errors; chi_square: the keypoint noise; "
        "mahalanobis: in tracking, the keypoint noise combined with the uncertainty of the point.",
        choices=("chi_square", "mahalanobis"),
    )
    max_chi_square: float = setting(
        5.991,
        "Maximum squared error in units of the noise; the default is the 95 % quantile for two degrees of freedom.",
        above=0,
        high=MAX_FACTOR,
    )
