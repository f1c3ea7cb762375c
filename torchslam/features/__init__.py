"""Image features: extractors (image -> Features) and matching."""

from torchslam.features.bits import hamming, pack_bits, unpack_bits
from torchslam.features.matching import match, match_projected
from torchslam.features.opencv_orb import OpenCVORB
from torchslam.features.orb import ORB

__all__ = ["ORB", "OpenCVORB", "hamming", "match", "match_projected", "pack_bits", "unpack_bits"]
