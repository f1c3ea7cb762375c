"""Multi-view geometry as pure, batched, differentiable functions over tensors."""

from torchslam.geometry.absolute_pose import AbsolutePose, estimate_absolute_pose
from torchslam.geometry.alignment import umeyama
from torchslam.geometry.camera import Camera
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
from torchslam.geometry.triangulation import (
    MultiViewTriangulation,
    Triangulation,
    correct_matches,
    triangulate,
    triangulate_many,
)

__all__ = [
    "AbsolutePose",
    "Camera",
    "MultiViewTriangulation",
    "Triangulation",
    "correct_matches",
    "estimate_absolute_pose",
    "matrix_from_quaternion",
    "p3p",
    "quaternion_from_matrix",
    "rigid",
    "se3_adjoint",
    "se3_exp",
    "se3_interpolate",
    "se3_inverse",
    "se3_log",
    "sim3_adjoint",
    "sim3_exp",
    "sim3_inverse",
    "sim3_log",
    "sim3_scale",
    "skew",
    "so3_exp",
    "so3_left_jacobian",
    "so3_log",
    "transform",
    "triangulate",
    "triangulate_many",
    "umeyama",
    "vee",
]
