"""Differentiable least squares: refinement of poses and of maps, robust, batched, with right gradients."""

from torchslam.solvers.bundle import BundleProblem, BundleSolution, bundle_adjust
from torchslam.solvers.pose import RefinedPose, refine_pose
from torchslam.solvers.prior import PosePrior

__all__ = [
    "BundleProblem",
    "BundleSolution",
    "PosePrior",
    "RefinedPose",
    "bundle_adjust",
    "refine_pose",
]
