"""Multi-view geometry as pure, batched, differentiable functions over tensors."""

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

__all__ = [
    "Camera",
    "matrix_from_quaternion",
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
    "umeyama",
    "vee",
]
