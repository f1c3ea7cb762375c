"""Cameras of kornia, from and to ours. Pixels mean the same in both: (0, 0) is the center of the first one.

kornia's PinholeCamera holds K and a pose, world to camera; here a camera and poses are apart. Gradients flow through.
Poses need no conversion: kornia's `Se3.from_matrix` takes them, and `Se3.matrix()` gives them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.camera import Camera

if TYPE_CHECKING:  # kornia is slow to import
    from kornia.geometry import PinholeCamera


def to_kornia_camera(camera: Camera, T_cw: Float[Tensor, "B 4 4"]) -> PinholeCamera:
    """One `kornia.geometry.PinholeCamera` for a batch of poses.

    Args:
        camera: a pinhole, one for all poses or one for each; kornia's has no distortion.
        T_cw: world to camera.

    Raises:
        ValueError: the camera has another model.
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
    """The pinholes of a batch, and the poses, world to camera.

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
