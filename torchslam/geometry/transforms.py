"""Changes of rigid transforms and similarities: distances, corrections, and the conventions of other programs.

Every change of axes is made here:

| | pose | camera axes | world | center of the top left pixel |
|---|---|---|---|---|
| torchslam | `T_cw`, `T_wc` | x right, y down, z forward | that of the map | (0, 0) |
| COLMAP | `T_cw`, quaternion w first | the same | that of the map | (0.5, 0.5) |
| nerfstudio | `T_wc` | OpenGL: x right, y up, z backward | z up | (0.5, 0.5) |
| PLY | | | z up | |
| kornia | `T_cw` | the same | that of the map | (0, 0) |
| rerun | `T_wc` | x right, y down, z forward (RDF) | z up | (0.5, 0.5) |
| TUM, KITTI | `T_wc` | x right, y down, z forward | that of the map | |
"""

from __future__ import annotations

import math
from itertools import permutations, product
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import (
    quaternion_from_matrix,
    rigid,
    se3_inverse,
    sim3_inverse,
    sim3_scale,
    transform,
)

if TYPE_CHECKING:  # kornia is slow to import
    from kornia.geometry import PinholeCamera


def pose_distance(
    T_cw: Float[Tensor, "4 4"], T_kw: Float[Tensor, "K 4 4"], depth: Float[Tensor, ""] | float
) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
    """Distances of cameras T_kw from T_cw, in units of a depth and in degrees."""
    T_ck = T_cw @ se3_inverse(T_kw)
    translation = torch.linalg.vector_norm(T_ck[:, :3, 3], dim=-1) / depth
    return translation, torch.rad2deg(rotation_angle(T_ck[:, :3, :3]))


def rotation_angle(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Angles of rotation matrices in radians, for decisions: without a gradient at 0 and pi."""
    sine = torch.linalg.vector_norm(R - R.mT, dim=(-2, -1)) / math.sqrt(8)
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.atan2(sine, cosine)


def reorthonormalized(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Reorthonormalize the rotations of nearly rigid transforms, to machine precision.

    In poses predicted from earlier ones, with transposes for inverses, the deviation from a rotation grows by a factor
    of 1 + sqrt(2) per frame. One step of Newton's iteration for the polar decomposition (Higham, 1986).
    """
    R = T[..., :3, :3]
    return rigid(1.5 * R - 0.5 * R @ (R.mT @ R), T[..., :3, 3])


def carry_points(
    points_w: Float[Tensor, "*batch 3"],
    covariances_w: Float[Tensor, "*batch 3 3"],
    normals_w: Float[Tensor, "*batch 3"],
    T_cw: Float[Tensor, "*batch 4 4"],
    S_cw: Float[Tensor, "*batch 4 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """Move points, covariances and unit normals as the pose T_cw of their camera is corrected to a similarity S_cw.

    T_cw and S_cw map the world to the camera of each point. A point keeps its direction and relative depth in it.
    """
    S_wc = sim3_inverse(S_cw)
    moved_w = transform(S_wc, transform(T_cw, points_w[..., None, :]))[..., 0, :]
    R_wc = S_wc[..., :3, :3] @ T_cw[..., :3, :3]
    normals = (sim3_scale(S_cw)[..., None, None] * R_wc @ normals_w[..., None])[..., 0]
    return moved_w, R_wc @ covariances_w @ R_wc.mT, normals


def with_unit(
    T: Float[Tensor, "*#batch 4 4"], unit: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*#batch 4 4"]:
    """Rigid transforms in a unit of length that is `unit` times as long."""
    return rigid(T[..., :3, :3], T[..., :3, 3] / unit[..., None])


def without_scale(S_cw: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """The pose of the camera of a similarity: its rotation and its center, in the unit of the world."""
    scale = sim3_scale(S_cw)
    return rigid(S_cw[..., :3, :3] / scale[..., None, None], S_cw[..., :3, 3] / scale[..., None])


def covariances_with_unit(
    covariances: Float[Tensor, "*#batch 6 6"], unit: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*#batch 6 6"]:
    """Covariances of poses, translation first, in a unit of length that is `unit` times as long."""
    units = torch.ones_like(covariances[..., 0])
    units[..., :3] = 1 / unit[..., None]
    return units[..., :, None] * covariances * units[..., None, :]


HALF_PIXEL = 0.5  # from an origin at the center of the top left pixel to one at its corner


def corner_pixels(pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
    """Pixels from the corner of the image, not from the center of its first pixel."""
    return pixels + HALF_PIXEL


def corner_camera(camera: Camera) -> Camera:
    """The camera whose pixels are those of `corner_pixels`."""
    params = camera.params.clone()
    params[..., 2:4] = corner_pixels(params[..., 2:4])
    return camera.with_params(params)


def opengl(T_wc: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Convert camera-to-world transforms to camera axes x right, y up, z backward."""
    return T_wc * T_wc.new_tensor((1.0, -1.0, -1.0, 1.0))


def signed_axes(like: Tensor) -> Float[Tensor, "48 3 3"]:
    """The matrices that exchange and reverse axes: 24 rotations, the identity first, and their mirror images."""
    eye = torch.eye(3, dtype=like.dtype, device=like.device)
    orders = torch.stack([eye[list(order)] for order in permutations(range(3))])
    signs = like.new_tensor(list(product((1.0, -1.0), repeat=3)))
    every = (orders[:, None] * signs[:, :, None]).flatten(0, 1)
    return every[torch.argsort(torch.linalg.det(every), descending=True, stable=True)]


def quaternion_wxyz(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions, w first and not negative, of rotation matrices."""
    return quaternion_from_matrix(R).roll(1, dims=-1)


def upright_rotation(T_wc: Float[Tensor, "N 4 4"]) -> Float[Tensor, "3 3"]:
    """Rotation from the world to one whose z is up and whose x is as close to the world's x as possible.

    Up is the mean up direction of the cameras; if that is zero (half of them are upside down), it is -y.
    """
    down = T_wc[:, :3, 1].mean(dim=0) if len(T_wc) else T_wc.new_zeros(3)
    if float(down.norm()) < 1e-3:  # a unit vector in any but made-up cases
        down = T_wc.new_tensor((0.0, 1.0, 0.0))
    return level_rotation(-down / down.norm())


def level_rotation(up_w: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """As `upright_rotation`, for a unit vector up_w; where up is nearly x, the world's z takes the place of x."""
    axis = up_w.new_tensor((1.0, 0.0, 0.0) if abs(float(up_w[0])) < 0.9 else (0.0, 0.0, 1.0))
    right = axis - (axis @ up_w) * up_w
    right = right / right.norm()
    return torch.stack((right, torch.linalg.cross(up_w, right), up_w))


def to_kornia_camera(camera: Camera, T_cw: Float[Tensor, "B 4 4"]) -> PinholeCamera:
    """One `kornia.geometry.PinholeCamera`, which holds K and a pose, for a batch of poses; with gradients.

    Args:
        camera: a pinhole, one for all poses or one for each.
        T_cw: world to camera; kornia's `Se3.from_matrix` takes it as it is.

    Raises:
        ValueError: the camera has another model: kornia's has no distortion.
    """
    from kornia.geometry import PinholeCamera

    if camera.model != "pinhole":
        raise ValueError(
            f"kornia's camera has no distortion, this one is of the model {camera.model!r}: undistort the images"
        )
    batch = len(T_cw)
    K = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device).repeat(batch, 1, 1)
    K[:, :3, :3] = camera.K
    height, width = (torch.full((batch,), side, device=T_cw.device) for side in (camera.height, camera.width))
    return PinholeCamera(K, T_cw, height, width)


def from_kornia_camera(camera: PinholeCamera) -> tuple[Camera, Float[Tensor, "B 4 4"]]:
    """The pinholes of a batch, and the poses, world to camera; with gradients.

    Raises:
        ValueError: the images of the batch have different sizes, or K has a skew.
    """
    sizes = {(int(w), int(h)) for w, h in zip(camera.width, camera.height, strict=True)}
    if len(sizes) != 1:
        raise ValueError(f"the images of the batch have different sizes: {sorted(sizes)}")
    K = camera.intrinsics[:, :3, :3]
    if bool((K[:, 0, 1] != 0).any()):
        raise ValueError("a camera with a skew is not a pinhole here")
    params = torch.stack((K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]), dim=-1)
    return Camera("pinhole", params, sizes.pop()), camera.extrinsics
