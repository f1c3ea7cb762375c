"""Differentiable least squares for poses, maps and pose graphs: robust, batched, with implicit gradients."""

from torchslam.optim._core.implicit import Backward
from torchslam.optim._core.levenberg_marquardt import (
    BUNDLE_OPTIONS,
    GRAPH_OPTIONS,
    LEAST_SQUARES_OPTIONS,
    POSE_GRAPH_OPTIONS,
    POSE_OPTIONS,
    ROTATION_OPTIONS,
    UNWEIGHTED_ROTATION_OPTIONS,
    Convergence,
    Progress,
    SolverOptions,
    SolverReason,
)
from torchslam.optim._core.tangent import CameraPrior, PosePrior
from torchslam.optim._least_squares import LeastSquaresSolution, Manifold, solve_least_squares
from torchslam.optim.bundle._factors import (
    DepthPrior,
    Factors,
    bounds_error,
    center_error,
    direction_error,
    displacement_error,
    log_distance_error,
    log_length_error,
    plane_error,
    pose_error,
    relative_pose_error,
)
from torchslam.optim.bundle._marginalization import marginalize
from torchslam.optim.bundle._problem import BundleProblem
from torchslam.optim.bundle._schur import Marginals
from torchslam.optim.bundle._scores import pose_covariance
from torchslam.optim.bundle._solve import BundleSolution, solve_bundle
from torchslam.optim.gradient_check import GradientCheck, check_gradient
from torchslam.optim.pose import RefinedPose, solve_pose
from torchslam.optim.pose_graph import PoseGraph, PoseGraphSolution, solve_pose_graph
from torchslam.optim.rotation_averaging import RotationAverage, solve_rotations
from torchslam.optim.sensor_estimate import CameraEstimate, CameraEvidence, camera_evidence

__all__ = [
    "BUNDLE_OPTIONS",
    "GRAPH_OPTIONS",
    "LEAST_SQUARES_OPTIONS",
    "POSE_GRAPH_OPTIONS",
    "POSE_OPTIONS",
    "ROTATION_OPTIONS",
    "UNWEIGHTED_ROTATION_OPTIONS",
    "Backward",
    "BundleProblem",
    "BundleSolution",
    "CameraEstimate",
    "CameraEvidence",
    "CameraPrior",
    "Convergence",
    "DepthPrior",
    "Factors",
    "GradientCheck",
    "LeastSquaresSolution",
    "Manifold",
    "Marginals",
    "PoseGraph",
    "PoseGraphSolution",
    "PosePrior",
    "Progress",
    "RefinedPose",
    "RotationAverage",
    "SolverOptions",
    "SolverReason",
    "bounds_error",
    "camera_evidence",
    "center_error",
    "check_gradient",
    "direction_error",
    "displacement_error",
    "log_distance_error",
    "log_length_error",
    "marginalize",
    "plane_error",
    "pose_covariance",
    "pose_error",
    "relative_pose_error",
    "solve_bundle",
    "solve_least_squares",
    "solve_pose",
    "solve_pose_graph",
    "solve_rotations",
]
