"""Multi-view geometry as pure, batched, differentiable functions over tensors."""

from torchslam.geometry.absolute_pose import AbsolutePose, estimate_absolute_pose
from torchslam.geometry.alignment import umeyama
from torchslam.geometry.camera import Camera
from torchslam.geometry.camera_tree import register
from torchslam.geometry.essential import (
    decompose_essential,
    epipolar_offsets,
    essential_from_pose,
    five_point,
    sampson_errors,
)
from torchslam.geometry.gating import (
    CHI_SQUARE_95,
    KeypointNoise,
    fits,
    innovation_covariances,
    mahalanobis_squared,
    squared_reprojection_errors,
)
from torchslam.geometry.homography import (
    decompose_homography,
    homography_from_matches,
    rotation_from_matches,
    transfer_errors,
)
from torchslam.geometry.lie import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    rigid,
    se3_adjoint,
    se3_exp,
    se3_interpolate,
    se3_inverse,
    se3_log,
    sim3_adjoint,
    sim3_exp,
    sim3_inverse,
    sim3_left_jacobian,
    sim3_left_jacobian_inverse,
    sim3_log,
    sim3_scale,
    skew,
    so3_exp,
    so3_left_jacobian,
    so3_log,
    transform,
    vee,
)
from torchslam.geometry.p3p import p3p
from torchslam.geometry.relative_pose import RelativePose, estimate_relative_pose
from torchslam.geometry.similarity import Similarity, estimate_similarity
from torchslam.geometry.start_pose import start_pose
from torchslam.geometry.triangulation import (
    MultiViewTriangulation,
    Triangulation,
    correct_matches,
    triangulate,
    triangulate_many,
    triangulation_covariance,
)
from torchslam.geometry.undistorted import UndistortedKeypoints, Undistortion

register()

__all__ = [
    "CHI_SQUARE_95",
    "AbsolutePose",
    "Camera",
    "KeypointNoise",
    "MultiViewTriangulation",
    "RelativePose",
    "Similarity",
    "Triangulation",
    "UndistortedKeypoints",
    "Undistortion",
    "correct_matches",
    "decompose_essential",
    "decompose_homography",
    "epipolar_offsets",
    "essential_from_pose",
    "estimate_absolute_pose",
    "estimate_relative_pose",
    "estimate_similarity",
    "fits",
    "five_point",
    "homography_from_matches",
    "innovation_covariances",
    "mahalanobis_squared",
    "matrix_from_quaternion",
    "p3p",
    "quaternion_from_matrix",
    "rigid",
    "rotation_from_matches",
    "sampson_errors",
    "se3_adjoint",
    "se3_exp",
    "se3_interpolate",
    "se3_inverse",
    "se3_log",
    "sim3_adjoint",
    "sim3_exp",
    "sim3_inverse",
    "sim3_left_jacobian",
    "sim3_left_jacobian_inverse",
    "sim3_log",
    "sim3_scale",
    "skew",
    "so3_exp",
    "so3_left_jacobian",
    "so3_log",
    "squared_reprojection_errors",
    "start_pose",
    "transfer_errors",
    "transform",
    "triangulate",
    "triangulate_many",
    "triangulation_covariance",
    "umeyama",
    "vee",
]
