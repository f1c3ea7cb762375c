"""What a keyframe does to the map, and what follows when its place was seen before."""

from __future__ import annotations

from dataclasses import dataclass

from torchslam.config.limits import LARGEST, LONGEST_PX, MOST
from torchslam.config.schema import Settings, setting


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
    max_drift_scale: float = setting(5.0, "likewise, of the scale, as a factor", low=1, high=LARGEST)
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
