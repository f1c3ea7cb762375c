"""The configuration: what can be set, with defaults and what each setting allows.

A configuration is valid however it was built: see `torchslam.settings`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from torchslam.named_configs import find
from torchslam.plugins import FRONT_ENDS, MATCHERS
from torchslam.settings import Settings, choices, enlarged, merged, setting, to_toml

__all__ = ["CHOICES", "Config", "load_config", "to_toml"]

MOST = 1_000_000
"""Of anything that is counted: more frames, keyframes or matches than that are none."""
LONGEST_PX = 10_000
"""Of a length in the image: no image is larger."""
LARGEST = 1_000_000
"""Of shares and factors that have no end of their own: far beyond what switches a test off."""
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
    threshold_px: float = setting(3.0, "of the PnP RANSAC", above=0, grows=True, high=LONGEST_PX)
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


@dataclass(frozen=True)
class JudgeConfig(Settings, section="judge"):
    """When a pose is uncertain: it makes no keyframe and no point until later frames confirm it."""

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


@dataclass(frozen=True)
class KeyframesConfig(Settings, section="keyframes"):
    max_translation: float = setting(
        0.10, "as a share of the median depth of the tracked points", low=0, high=LARGEST
    )
    max_rotation_deg: float = setting(12.0, "from the reference keyframe", low=0, high=180)
    min_overlap: float = setting(
        0.8, "tracked points as a share of the well observed ones of the reference keyframe", low=0, high=1
    )
    min_interval: int = setting(0, "frames between two keyframes", low=0, high=MOST)


@dataclass(frozen=True)
class MappingConfig(Settings, section="mapping"):
    partners: str = setting(
        "covisible", "keyframes that new points are triangulated against", choices=("covisible", "last")
    )
    neighbours: int = setting(5, "how many of them", low=1, high=MOST)
    min_parallax_deg: float = setting(1.0, "of a new point", low=0, high=180)
    epipolar_px: float = setting(
        2.0, "distance of a match from its epipolar line, at most", above=0, high=LONGEST_PX
    )
    min_baseline: float = setting(0.01, "as a share of the median depth", low=0, high=LARGEST)
    fuse: bool = setting(True, "merge points that are the same")
    cull: bool = setting(True, "remove points that are not found again")
    min_found_share: float = setting(0.25, "of the frames that should have seen a point", low=0, high=1)


@dataclass(frozen=True)
class LoopsConfig(Settings, section="loops"):
    """When a keyframe shows a place that the map knows from another time, or that another world knows."""

    enabled: bool = setting(True, "whether places are recognised")
    candidates: int = setting(3, "places compared for each keyframe", low=1, high=MOST)
    min_matches: int = setting(40, "points of the other place that the keyframe must see", low=6, high=MOST)
    min_pairs: int = setting(20, "of these, known to the keyframe's own map as well", low=3, high=MOST)
    min_confirming: int = setting(
        2, "keyframes beside it that must see the other place too", low=0, high=MOST
    )
    max_drift: float = setting(
        0.2,
        "how far a map may have drifted, as a share of the length of the way between",
        above=0,
        high=LARGEST,
    )
    max_drift_deg: float = setting(20.0, "likewise, of the rotation", above=0, high=180)
    max_drift_scale: float = setting(2.0, "likewise, of the scale, as a factor", low=1, high=LARGEST)
    adjust: bool = setting(True, "the whole map after a loop was closed or worlds were joined")


@dataclass(frozen=True)
class BundleConfig(Settings, section="bundle"):
    enabled: bool = setting(True, "adjust the newest keyframes and their points after each keyframe")
    window: int = setting(8, "keyframes whose poses are free", low=2, high=MOST)
    max_fixed: int = setting(12, "keyframes that hold them", low=1, high=MOST)
    iterations: int = setting(6, "of it", low=1, high=10_000)
    delay: int = setting(
        2,
        "frames that are tracked before its outcome is taken over, so that it can be found beside them",
        low=0,
        high=MOST,
    )
    final: bool = setting(True, "one bundle adjustment over the whole map when the run ends")
    final_iterations: int = setting(15, "of that one", low=1, high=10_000)


@dataclass(frozen=True)
class Config(Settings):
    """All settings, section by section: `Config(loops=LoopsConfig(enabled=False))`, or read by `load_config`.

    Frozen, like its sections: `dataclasses.replace` makes another one. Raises ConfigError for a value that is not
    allowed, however it is made.
    """

    seed: int = setting(0, "of all random choices", low=0, high=2**63 - 1)
    scale: str = setting(
        "unit",
        "length of a map unit; unit: the median depth of the first map is 1",
        choices=("unit", "groundtruth"),
    )
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    simulated: SimulatedConfig = field(default_factory=SimulatedConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    patches: PatchesConfig = field(default_factory=PatchesConfig)
    stillness: StillnessConfig = field(default_factory=StillnessConfig)
    independent_motion: IndependentMotionConfig = field(default_factory=IndependentMotionConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    keyframes: KeyframesConfig = field(default_factory=KeyframesConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    loops: LoopsConfig = field(default_factory=LoopsConfig)
    bundle: BundleConfig = field(default_factory=BundleConfig)

    def for_size(self, size: tuple[int, int]) -> Config:
        """The configuration for images (width, height): what is said in pixels of reduced ones grows with them.

        What is said in units of a keypoint's scale does not: the scale has grown already.
        """
        return enlarged(self, self.features.reduction(size))


CHOICES = choices(Config)
"""The settings that are one of a few words, by full name."""


def load_config(path: Path | str | None = None, overrides: Iterable[str] = ()) -> Config:
    """The defaults, changed by a TOML file, changed by overrides of the form `section.key=value`.

    path: of the file, or as a string the name of one of `configs/`, such as "fast"

    Raises ConfigError for a missing or malformed file, an unknown key, or a value of the wrong type or not allowed.
    """
    return merged(Config(), None if path is None else find(path), overrides)
