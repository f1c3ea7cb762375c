"""Train through SLAM: clips of sequences, differentiable poses of clips, losses, and resumable training."""

from torchslam.learning.clip_slam import (
    ClipGraph,
    ClipLoss,
    ClipPoses,
    ClipSLAM,
    clip_halves,
    clip_loss,
    clip_mean,
)
from torchslam.learning.dataset import (
    Batches,
    Clip,
    Clips,
    GraphCache,
    clips_with_a_map,
    collate,
    count_reasons,
    frames_in,
    parallax,
)
from torchslam.learning.losses import (
    clip_reprojection,
    epipolar_loss,
    motion_difference,
    path_length,
    pose_errors,
    pose_nll,
    relative_ate,
    reprojection_loss,
)
from torchslam.learning.training import Log, Training

__all__ = [
    "Batches",
    "Clip",
    "ClipGraph",
    "ClipLoss",
    "ClipPoses",
    "ClipSLAM",
    "Clips",
    "GraphCache",
    "Log",
    "Training",
    "clip_halves",
    "clip_loss",
    "clip_mean",
    "clip_reprojection",
    "clips_with_a_map",
    "collate",
    "count_reasons",
    "epipolar_loss",
    "frames_in",
    "motion_difference",
    "parallax",
    "path_length",
    "pose_errors",
    "pose_nll",
    "relative_ate",
    "reprojection_loss",
]
