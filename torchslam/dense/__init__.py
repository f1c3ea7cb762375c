"""Dense depth from posed images: pure, batched functions on any device, and the two results, maps and a cloud."""

from torchslam.dense.cloud import CloudFusion, PointCloud
from torchslam.dense.consistency import (
    Merged,
    as_seen_by,
    confidence_alone,
    confidence_together,
    depth_normals,
    kept,
    merge,
    render,
)
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
from torchslam.dense.estimate import Estimate, choose_neighbors, estimate_depth, neighbor_scores, refine_depth
from torchslam.dense.learned import RatingNet, learned_confidence, net_inputs

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
