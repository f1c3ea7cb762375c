"""Differentiable least squares: poses, maps and pose graphs refined, robust, batched, with right gradients."""

from torchslam.solvers.bundle import BundleProblem, BundleSolution, bundle_adjust
from torchslam.solvers.least_squares import LeastSquaresSolution, minimize
from torchslam.solvers.pose import RefinedPose, refine_pose
from torchslam.solvers.pose_graph import PoseGraph, PoseGraphSolution, pose_graph_optimize
from torchslam.solvers.prior import CameraPrior, PosePrior
from torchslam.solvers.schur import Marginals

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
