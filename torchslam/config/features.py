"""Images and what is measured in them: features, their matching, how far they may lie from where they should."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchslam.config.limits import LARGEST, LONGEST_PX
from torchslam.config.schema import Settings, setting
from torchslam.plugins import FRONT_ENDS, MATCHERS

MAX_PIXELS = 1 << 26
"""Of the largest image that is decoded."""
TOLERATED = 1.6
"""Times the pixels that images are reduced to: those with no more than this do as well as they are."""


@dataclass(frozen=True)
class FeaturesConfig(Settings, section="features"):
    kind: str = setting(
        "orb",
        "front end: what finds and describes keypoints",
        choices=("orb", "opencv-orb", "simulated", "xfeat", "aliked"),
        group=FRONT_ENDS,
    )
    num_keypoints: int = setting(1000, "of an image, at most", low=1, high=100_000)
    image_pixels: int = setting(
        640 * 480,
        "that much larger images are reduced to before anything is looked for; 0: all are taken as they are",
        low=32 * 32,
        high=MAX_PIXELS,
        also=0,
    )
    weights: str = setting("", "file with the weights of a learned front end")

    def reduction(self, size: tuple[int, int]) -> float:
        """By what factor, in width and in height, images (width, height) are reduced: at least 1."""
        pixels = size[0] * size[1]
        if self.kind == "simulated" or self.image_pixels == 0 or pixels <= TOLERATED * self.image_pixels:
            return 1.0
        return math.sqrt(pixels / self.image_pixels)


@dataclass(frozen=True)
class SimulatedConfig(Settings, section="simulated"):
    """Simulated features: points scattered in the views of the true trajectory and projected through it."""

    points_per_view: int = setting(400, "points scattered in each of the views", low=1, high=100_000)
    depth_near: float = setting(
        0.1, "of the nearest point, as a share of the extent of the trajectory", above=0, high=LARGEST
    )
    depth_far: float = setting(1.0, "of the farthest point, likewise", above=0, high=LARGEST)
    noise_px: float = setting(0.0, "standard deviation of the keypoints", low=0, high=LONGEST_PX)
    outliers: float = setting(0.0, "share of the keypoints that lie at a random place", low=0, high=1)
    dropout: float = setting(0.0, "share of the visible points that a frame misses", low=0, high=1)
    scales: bool = setting(
        False,
        "points have a size: keypoints have scales by their depth, and noise that grows with them",
    )


@dataclass(frozen=True)
class MatchingConfig(Settings, section="matching"):
    max_distance: float = setting(
        64.0, "between binary descriptors, bits; learned features use max_cosine_distance", above=0, high=4096
    )
    max_cosine_distance: float = setting(0.25, "between descriptors of floats: 1 - cosine", above=0, high=2)
    ratio: float = setting(0.8, "of the best to the second best distance, at most", above=0, high=1)
    matcher: str = setting(
        "descriptors",
        "who matches two views, also a map's points with a view; descriptors: nearest and mutual",
        choices=("descriptors", "lightglue"),
        group=MATCHERS,
    )
    weights: str = setting("", "file with the weights of a learned matcher")


@dataclass(frozen=True)
class MeasurementConfig(Settings, section="measurement"):
    """How far a keypoint may lie from where its point is predicted: the one test of tracking, mapping and adjusting."""

    gate: str = setting(
        "chi_square",
        "chi_square: errors in units of the pixel noise | mahalanobis: in tracking of that and the point's uncertainty",
        choices=("chi_square", "mahalanobis"),
    )
    chi_square: float = setting(
        5.991,
        "squared error of a keypoint in these units, at most: 95 % of two degrees of freedom",
        above=0,
        high=LARGEST,
    )
