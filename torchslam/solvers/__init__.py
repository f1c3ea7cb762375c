"""Differentiable least squares: refinement of poses and of maps, robust, batched, with right gradients."""

from torchslam.solvers.pose import RefinedPose, refine_pose
from torchslam.solvers.prior import PosePrior

__all__ = ["PosePrior", "RefinedPose", "refine_pose"]
