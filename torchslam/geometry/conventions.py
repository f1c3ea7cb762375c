"""What other programs mean by a pose, a pixel and up: every change of axes is made here.

| | pose | camera axes | world | centre of the top left pixel |
|---|---|---|---|---|
| torchslam | `T_cw`, `T_wc` | x right, y down, z forward | that of the map | (0, 0) |
| COLMAP | `T_cw`, quaternion w first | the same | that of the map | (0.5, 0.5) |
| nerfstudio | `T_wc` | OpenGL: x right, y up, z backward | z up | (0.5, 0.5) |
| PLY | | | z up | |
| rerun | `T_wc` | x right, y down, z forward (RDF) | z up | (0.5, 0.5) |
| TUM, KITTI | `T_wc` | x right, y down, z forward | that of the map | |
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import quaternion_from_matrix

HALF_PIXEL = 0.5  # from an origin at the centre of the top left pixel to one at its corner


def corner_pixels(pixels: Tensor) -> Tensor:
    """Pixels (..., 2) from the corner of the image, not from the centre of its first pixel."""
    return pixels + HALF_PIXEL


def corner_camera(camera: Camera) -> Camera:
    """The camera whose pixels are those of `corner_pixels`."""
    params = camera.params.clone()
    params[..., 2:4] += HALF_PIXEL
    return camera.with_params(params)


def opengl(T_wc: Tensor) -> Tensor:
    """Camera to world (..., 4, 4) for camera axes x right, y up, z backward."""
    return T_wc * T_wc.new_tensor((1.0, -1.0, -1.0, 1.0))


def quaternion_wxyz(R: Tensor) -> Tensor:
    """Unit quaternions (..., 4), w first and not negative, of rotation matrices (..., 3, 3)."""
    return quaternion_from_matrix(R).roll(1, dims=-1)


def upright_rotation(T_wc: Tensor) -> Tensor:
    """(3, 3) from the world to one whose z is up and whose x is as near to the world's x as can be.

    T_wc: (N, 4, 4). Gravity is not known: up is the mean up direction of the cameras. Where they have none, as when
    half of them hang upside down, it is that of a world whose y points down.
    """
    down = T_wc[:, :3, 1].mean(dim=0) if len(T_wc) else T_wc.new_zeros(3)
    if float(down.norm()) < 1e-3:  # a unit vector in any but made-up cases
        down = T_wc.new_tensor((0.0, 1.0, 0.0))
    up = -down / down.norm()
    axis = T_wc.new_tensor((1.0, 0.0, 0.0) if abs(float(up[0])) < 0.9 else (0.0, 0.0, 1.0))
    right = axis - (axis @ up) * up
    right = right / right.norm()
    return torch.stack((right, torch.linalg.cross(up, right), up))
