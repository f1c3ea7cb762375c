"""Dense depth from posed images: pure, batched functions on any device, and the two results, maps and a cloud."""

from torchslam.dense.cloud import PointCloud
from torchslam.dense.depth_maps import DepthMaps

__all__ = ["DepthMaps", "PointCloud"]
