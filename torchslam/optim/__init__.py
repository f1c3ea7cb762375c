"""Differentiable least squares for poses, maps and pose graphs: robust, batched, with implicit gradients."""

from torchslam.optim._core.implicit import Backward
from torchslam.optim._core.levenberg_marquardt import Convergence, Progress
from torchslam.optim._core.tangent import CameraPrior, PosePrior
from torchslam.optim._least_squares import LeastSquaresSolution, Manifold, minimize
from torchslam.optim.bundle._api import BundleProblem, BundleSolution, bundle_adjust
from torchslam.optim.bundle._factors import (
    DepthPrior,
    FrameFactors,
    log_distance_error,
    relative_pose_error,
)
from torchslam.optim.bundle._schur import Marginals
from torchslam.optim.global_positioning import GlobalPositions, position_globally
from torchslam.optim.pose._refinement import RefinedPose, refine_pose
from torchslam.optim.pose_graph._api import PoseGraph, PoseGraphSolution, pose_graph_optimize
from torchslam.optim.rotation_averaging import RotationAverage, average_rotations

__all__ = [
    "Backward",
    "BundleProblem",
    "BundleSolution",
    "CameraPrior",
    "Convergence",
    "DepthPrior",
    "FrameFactors",
    "GlobalPositions",
    "LeastSquaresSolution",
    "Manifold",
    "Marginals",
    "PoseGraph",
    "PoseGraphSolution",
    "PosePrior",
    "Progress",
    "RefinedPose",
    "RotationAverage",
    "average_rotations",
    "bundle_adjust",
    "log_distance_error",
    "minimize",
    "pose_graph_optimize",
    "position_globally",
    "refine_pose",
    "relative_pose_error",
]
