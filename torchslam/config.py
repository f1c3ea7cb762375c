"""The configuration: what can be set, with defaults and what each setting allows.

A configuration is valid however it was built: see `torchslam.settings`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from torchslam.settings import Settings, choices, enlarged, merged, setting, to_toml

__all__ = ["CHOICES", "Config", "load_config", "to_toml"]

TOLERATED = 1.6
"""Times the pixels that images are reduced to: those with no more than this do as well as they are."""


@dataclass(frozen=True)
class FeaturesConfig(Settings, section="features"):
    kind: str = setting("orb", choices=("orb", "opencv-orb", "simulated", "xfeat", "aliked"))
    num_keypoints: int = setting(1000, low=1)
    # that much larger images are reduced to before anything is looked for; 0: all are taken as they are
    image_pixels: int = setting(640 * 480, low=0)
    weights: str = ""  # file with the weights of a learned front end

    def reduction(self, size: tuple[int, int]) -> float:
        """By what factor, in width and in height, images (width, height) are reduced: at least 1."""
        pixels = size[0] * size[1]
        if self.kind == "simulated" or self.image_pixels == 0 or pixels <= TOLERATED * self.image_pixels:
            return 1.0
        return math.sqrt(pixels / self.image_pixels)


@dataclass(frozen=True)
class SimulatedConfig(Settings, section="simulated"):
    """Simulated features: points scattered in the views of the true trajectory and projected through it."""

    points_per_view: int = setting(400, low=1)
    depth_near: float = setting(0.1, above=0)  # as a share of the extent of the trajectory
    depth_far: float = setting(1.0, above=0)
    noise_px: float = setting(0.0, low=0)
    outliers: float = setting(0.0, low=0, high=1)  # share of the keypoints that lie at a random place
    dropout: float = setting(0.0, low=0, high=1)  # share of the visible points that a frame misses
    # points have a size: keypoints have scales by their depth, and noise that grows with them; else all scales are one
    scales: bool = False


@dataclass(frozen=True)
class MatchingConfig(Settings, section="matching"):
    max_distance: float = setting(64.0, above=0)  # bits; learned features use max_cosine_distance
    max_cosine_distance: float = setting(0.25, above=0, high=2)
    ratio: float = setting(0.8, above=0, high=1)


@dataclass(frozen=True)
class MeasurementConfig(Settings, section="measurement"):
    """How far a keypoint may lie from where its point is predicted: the one test of tracking, mapping and adjusting."""

    # chi_square: errors in units of the pixel noise | mahalanobis: in tracking of that and the point's uncertainty
    gate: str = setting("chi_square", choices=("chi_square", "mahalanobis"))
    chi_square: float = setting(5.991, above=0)  # 95 % of two degrees of freedom


@dataclass(frozen=True)
class InitializationConfig(Settings, section="initialization"):
    # what makes a point of the start a good one; configs/paper.toml goes by the parallax
    criterion: str = setting("uncertainty", choices=("uncertainty", "parallax"))
    min_matches: int = setting(100, low=1)  # fewer than this with the reference frame: a new reference
    # of the matches, in the median; less is a standstill
    min_motion_px: float = setting(2.0, low=0, grows=True)
    still_px: float = setting(1.0, above=0, grows=True)  # matches that moved less stay in place
    min_points: int = setting(60, low=1)
    threshold_px: float = setting(1.5, above=0, grows=True)
    # uncertainty: a point counts when its relative depth is known better than this
    max_depth_std: float = setting(0.1, above=0)
    min_good_share: float = setting(0.15, low=0, high=1)  # ... and this share of the matches must count
    planar_patience: int = setting(10, low=0)  # frames that look planar before a plane is believed
    min_planar_share: float = setting(0.5, low=0, high=1)  # uncertainty: ... of the matches on a plane
    min_parallax_deg: float = setting(3.0, low=0, high=180)  # parallax: a point counts from this angle on
    min_mean_parallax_deg: float = setting(5.0, low=0, high=180)
    # share of the frames since the reference that the start must explain
    min_explained: float = setting(0.8, low=0, high=1)
    max_reference_age: int = setting(300, low=2)  # frames; an older reference is replaced
    # frames without a pose that are kept, to be posed once there is a map
    max_waiting: int = setting(1000, low=0)
    # a world that was lost before it had tracked this many frames after its start is taken back
    min_frames: int = setting(20, low=0)


@dataclass(frozen=True)
class TrackingConfig(Settings, section="tracking"):
    predict: bool = True  # constant velocity; without it the previous pose
    guided: bool = True  # match near the projection first; without it brute force alone
    radius_px: float = setting(12.0, above=0)  # at the finest pyramid level
    wide_radius_factor: float = setting(3.0, low=1)
    refine_radius_px: float = setting(5.0, above=0)
    threshold_px: float = setting(3.0, above=0, grows=True)  # of the PnP RANSAC
    min_matches: int = setting(20, low=1)
    min_inliers: int = setting(20, low=1)
    local_keyframes: int = setting(12, low=1)
    max_view_angle_deg: float = setting(60.0, above=0, high=180)
    # match points seen in the last n frames instead of the co-visible ones; 0: co-visible
    recent_frames: int = setting(0, low=0)


@dataclass(frozen=True)
class PatchesConfig(Settings, section="patches"):
    """When a frame is followed by patches of an earlier one, without features of its own."""

    enabled: bool = False
    count: int = setting(300, low=20)  # patches that are followed
    min_similarity: float = setting(0.8, low=0, high=1)  # normalised cross-correlation with the earlier frame
    min_share: float = setting(0.6, above=0, high=1)  # of the patches, that must agree with the pose
    # median squared error of the pose, as a multiple of that of the frame that they are from
    max_error_growth: float = setting(2.5, above=0)
    max_frames: int = setting(5, low=1)  # followed one after the other
    # of the overlap at which a frame becomes a keyframe: patches are lost sooner than matches
    overlap_share: float = setting(0.8, above=0)
    # frames after which is known what came of one that was found by its features: it is mapped meanwhile
    delay: int = setting(2, low=0, high=64)


@dataclass(frozen=True)
class StillnessConfig(Settings, section="stillness"):
    """When pixels stay in place that should have moved with the scene, as logos and dirt on the lens do."""

    enabled: bool = True
    # a point of the scene would have moved by at least this
    min_motion_px: float = setting(4.0, above=0, grows=True)
    min_moving_share: float = setting(0.5, low=0, high=1)  # of the keypoints, before two frames are compared
    radius_px: float = setting(1.5, above=0, grows=True)  # within which a keypoint has stayed
    # of the cells that evidence is kept of: a corner wanders a little under noise
    cell_px: float = setting(4.0, above=0, grows=True)
    max_distance_share: float = setting(0.6, above=0, high=1)  # of the distance at which descriptors match
    min_keypoints: int = setting(8, low=1)  # fewer that stay are chance
    min_evidence: int = setting(2, low=1)  # comparisons in which a pixel stayed


@dataclass(frozen=True)
class IndependentMotionConfig(Settings, section="independent_motion"):
    """When a part of the image moves against the scene, as people and cars do."""

    enabled: bool = True
    frames: int = setting(5, low=1)  # from one comparison to the next
    min_error_px: float = setting(4.0, above=0)  # by which a match misses where a point of the scene can be
    threshold_px: float = setting(2.0, above=0, grows=True)  # of the motion that they share
    # how far a keypoint is looked for from where the last motion took it
    search_px: float = setting(16.0, above=0, grows=True)
    min_matches: int = setting(20, low=5)
    min_share: float = setting(0.5, low=0, high=1)  # of the matches that miss the scene
    max_share: float = setting(2.0, above=0)  # of the image, as a multiple of what agrees with the map
    max_unseen: int = setting(150, low=1)  # frames that it is followed without being seen to move


@dataclass(frozen=True)
class JudgeConfig(Settings, section="judge"):
    """When a pose is uncertain: it makes no keyframe and no point until later frames confirm it."""

    min_inlier_share: float = setting(0.5, low=0, high=1)  # of the matches around the predicted pixels
    max_error: float = setting(1.3, above=0)  # median squared error in units of the noise, over ten frames
    # of the image, where it has keypoints: what the map explains, over ten frames
    min_explained: float = setting(0.3, low=0, high=1)
    min_coverage: float = setting(0.2, low=0, high=1)  # of the image, where the map expects something
    # standard deviations; of the position as a share of the median depth of the tracked points
    max_position_std: float = setting(0.017, above=0)
    max_rotation_std_deg: float = setting(0.9, above=0)
    max_jump: float = setting(0.5, above=0)  # from the predicted position, as a share of the depth
    max_turn_deg: float = setting(20.0, above=0, high=180)  # from the predicted rotation
    confirmations: int = setting(2, low=1)  # certain frames in a row after an uncertain one


@dataclass(frozen=True)
class RelocalizationConfig(Settings, section="relocalization"):
    """What happens after the camera is lost."""

    tries: int = setting(3, low=1)  # places compared a frame
    # certain frames in a row after a relocalised one, before anything is mapped
    confirmations: int = setting(4, low=1)
    patience: int = setting(20, low=0)  # lost frames before a new world may begin


@dataclass(frozen=True)
class KeyframesConfig(Settings, section="keyframes"):
    max_translation: float = setting(0.10, low=0)  # as a share of the median depth of the tracked points
    max_rotation_deg: float = setting(12.0, low=0, high=180)
    # tracked points as a share of the well observed ones of the reference keyframe
    min_overlap: float = setting(0.8, low=0, high=1)
    min_interval: int = setting(0, low=0)  # frames between two keyframes


@dataclass(frozen=True)
class MappingConfig(Settings, section="mapping"):
    # keyframes that new points are triangulated against
    partners: str = setting("covisible", choices=("covisible", "last"))
    neighbours: int = setting(5, low=1)  # how many of them
    min_parallax_deg: float = setting(1.0, low=0, high=180)
    epipolar_px: float = setting(2.0, above=0)
    min_baseline: float = setting(0.01, low=0)  # as a share of the median depth
    fuse: bool = True
    cull: bool = True
    min_found_share: float = setting(0.25, low=0, high=1)


@dataclass(frozen=True)
class LoopsConfig(Settings, section="loops"):
    """When a keyframe shows a place that the map knows from another time, or that another world knows."""

    enabled: bool = True
    candidates: int = setting(3, low=1)  # places compared for each keyframe
    min_matches: int = setting(40, low=6)  # points of the other place that the keyframe must see
    min_pairs: int = setting(20, low=3)  # of these, known to the keyframe's own map as well
    min_confirming: int = setting(2, low=0)  # keyframes beside it that must see the other place too
    # how far a map may have drifted: from the length of the way between, in degrees, as a factor
    max_drift: float = setting(0.2, above=0)
    max_drift_deg: float = setting(20.0, above=0, high=180)
    max_drift_scale: float = setting(2.0, low=1)
    adjust: bool = True  # the whole map after a loop was closed or worlds were joined


@dataclass(frozen=True)
class BundleConfig(Settings, section="bundle"):
    enabled: bool = True
    window: int = setting(8, low=2)  # keyframes whose poses are free
    max_fixed: int = setting(12, low=1)
    iterations: int = setting(6, low=1)
    final: bool = True  # one bundle adjustment over the whole map when the run ends
    final_iterations: int = setting(15, low=1)


@dataclass(frozen=True)
class Config(Settings):
    seed: int = setting(0, low=0, high=2**63 - 1)
    # unit: the median depth of the first map is 1
    scale: str = setting("unit", choices=("unit", "groundtruth"))
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

    Raises ConfigError for a missing or malformed file, an unknown key, or a value of the wrong type or not allowed.
    """
    return merged(Config(), path, overrides)
