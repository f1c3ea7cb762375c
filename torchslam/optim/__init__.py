"""Differentiable least squares: poses, maps and pose graphs refined, robust, batched, with right gradients."""

from torchslam.optim.bundle._schur import Marginals
from torchslam.optim.bundle.api import BundleProblem, BundleSolution, bundle_adjust
from torchslam.optim.core.priors import CameraPrior, PosePrior
from torchslam.optim.least_squares import LeastSquaresSolution, minimize
from torchslam.optim.pose.refinement import RefinedPose, refine_pose
from torchslam.optim.pose_graph.api import PoseGraph, PoseGraphSolution, pose_graph_optimize

__all__ = [
    "BundleProblem",
    "BundleSolution",
    "CameraPrior",
    "LeastSquaresSolution",
    "Marginals",
    "PoseGraph",
    "PoseGraphSolution",
    "PosePrior",
    "RefinedPose",
    "bundle_adjust",
    "minimize",
    "pose_graph_optimize",
    "refine_pose",
]
