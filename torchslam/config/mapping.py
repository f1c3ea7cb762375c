"""Settings of keyframe selection, mapping, loop closing and bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

from torchslam.config.limits import MAX_COUNT, MAX_FACTOR, MAX_LENGTH_PX
from torchslam.config.schema import Settings, setting


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
        6, "Maximum number of iterations of the local bundle adjustment.", low=1, high=10_000
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
        15, "Maximum number of iterations of a global bundle adjustment.", low=1, high=10_000
    )
