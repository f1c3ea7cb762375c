"""Dense depth from posed images: pure, batched functions on any device, and the two results, maps and a cloud."""

from torchslam.dense.cloud import PointCloud
from torchslam.dense.confidence import confidence_alone, confidence_together, kept
from torchslam.dense.consistency import Merged, as_seen_by, merge, render
from torchslam.dense.cost_volume import (
    Aggregation,
    Minimum,
    find_minimum,
    inverse_depth_planes,
    matching_cost,
    semi_global,
    warp,
)
from torchslam.dense.depth_maps import DepthMaps
from torchslam.dense.estimate import Estimate, estimate_depth, refine_depth
from torchslam.dense.fusion import CloudFusion
from torchslam.dense.learned import RatingNet, learned_confidence, net_inputs
from torchslam.dense.neighbors import choose_neighbors, neighbor_scores
from torchslam.dense.normals import depth_normals

__all__ = [
    "Aggregation",
    "CloudFusion",
    "DepthMaps",
    "Estimate",
    "Merged",
    "Minimum",
    "PointCloud",
    "RatingNet",
    "as_seen_by",
    "choose_neighbors",
    "confidence_alone",
    "confidence_together",
    "depth_normals",
    "estimate_depth",
    "find_minimum",
    "inverse_depth_planes",
    "kept",
    "learned_confidence",
    "matching_cost",
    "merge",
    "neighbor_scores",
    "net_inputs",
    "refine_depth",
    "render",
    "semi_global",
    "warp",
]
