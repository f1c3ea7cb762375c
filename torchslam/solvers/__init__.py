"""Differentiable least squares: refinement of poses and of maps, robust, batched, with right gradients."""

from torchslam.solvers.bundle import BundleProblem, BundleSolution, bundle_adjust
from torchslam.solvers.pose import RefinedPose, refine_pose
from torchslam.solvers.prior import PosePrior
from torchslam.solvers.schur import Marginals

__all__ = [
    "BundleProblem",
    "BundleSolution",
    "Marginals",
    "PosePrior",
    "RefinedPose",
    "bundle_adjust",
    "refine_pose",
]
