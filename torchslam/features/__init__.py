"""Image features: extractors (image -> Features) and matching."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from torchslam.errors import ConfigError
from torchslam.features.learned import ALIKED, XFeat
from torchslam.features.matching.brute_force import match, match_pairs
from torchslam.features.matching.by_projection import expand_runs, match_by_projection
from torchslam.features.matching.hamming import hamming, pack_bits, unpack_bits
from torchslam.features.opencv import SIFT, OpenCVORB
from torchslam.features.orb import ORB
from torchslam.features.simulated import SimulatedFeatures

__all__ = [
    "ALIKED",
    "EXTRACTORS",
    "ORB",
    "SIFT",
    "OpenCVORB",
    "SimulatedFeatures",
    "XFeat",
    "expand_runs",
    "extractor",
    "hamming",
    "match",
    "match_by_projection",
    "match_pairs",
    "pack_bits",
    "unpack_bits",
]

EXTRACTORS = ("orb", "opencv-orb", "sift", "xfeat", "aliked")
"""Names that `extractor` knows."""


def extractor(name: str, num_keypoints: int = 1000, weights: str | Path | None = None) -> nn.Module:
    """Make the extractor of a name.

    Args:
        name: one of `EXTRACTORS`.
        num_keypoints: largest number of keypoints per image.
        weights: file of weights for "xfeat" and "aliked", or their name, see `features.weights`; None: the published
            ones of that name. Unused by the others.

    Returns:
        A module from images (B, 1, H, W) and optionally a mask to `Features`.

    Raises:
        ConfigError: The name is unknown, or the weights are missing or unreadable.
    """
    if name == "orb":
        return ORB(num_keypoints)
    if name == "opencv-orb":
        return OpenCVORB(num_keypoints)
    if name == "sift":
        return SIFT(num_keypoints)
    if name not in EXTRACTORS:
        raise ConfigError(f"unknown features {name!r}; there are {', '.join(EXTRACTORS)}")
    if name == "xfeat":
        return XFeat(weights or "xfeat", num_keypoints)
    return ALIKED(weights or "aliked", num_keypoints)
