"""An empty room, a cube around the origin, with exact depth, normals and colors for any pinhole camera in it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.dense import DepthMaps, PointCloud
from torchslam.geometry import Camera, se3_inverse, transform

HALF = 3.0
"""Half of the side of the cube."""
CONFIDENCE = 0.75


def box_depths(T_cw: Tensor, frame_index: Tensor, camera: Camera) -> DepthMaps:
    """Exact maps of cameras (K, 4, 4) inside of the room; normals of a wall point into the room."""
    points_w, depth = _hits(T_cw, camera)
    axis = points_w.abs().argmax(dim=-1, keepdim=True)
    normals_w = torch.zeros_like(points_w).scatter(-1, axis, -points_w.gather(-1, axis).sign())
    normals_c = normals_w @ T_cw[:, None, :3, :3].mT
    return DepthMaps(
        frame_index=frame_index,
        depth=depth.float(),
        normal=normals_c.permute(0, 3, 1, 2).float().contiguous(),
        confidence=torch.full_like(depth, CONFIDENCE).float(),
        T_cw=T_cw.double(),
        camera=camera,
    )


def box_cloud(maps: DepthMaps) -> PointCloud:
    """Every pixel of the maps as a point, in the colors of the walls."""
    points_w, _ = _hits(maps.T_cw, maps.camera)
    normals_w = maps.normal.double().permute(0, 2, 3, 1) @ maps.T_cw[:, None, :3, :3]
    points_w, normals_w = points_w.reshape(-1, 3), normals_w.reshape(-1, 3)
    confidence = maps.confidence.flatten()
    return PointCloud(points_w.float(), normals_w.float(), wall_colors(points_w), confidence)


def wall_colors(points_w: Tensor) -> Tensor:
    """Red, green, blue of points (N, 3): the position."""
    return ((points_w / HALF + 1) / 2 * 255).round().clamp(0, 255).to(torch.uint8)


def _hits(T_cw: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """(K, H, W, 3) where the rays of the pixels meet the walls, and (K, H, W) their depth."""
    v, u = torch.meshgrid(*(torch.arange(side).double() for side in reversed(camera.size)), indexing="ij")
    rays_c = torch.nn.functional.pad(
        camera.to(torch.float64).normalize(torch.stack((u, v), -1)), (0, 1), value=1.0
    )
    T_wc = se3_inverse(T_cw.double())[:, None]
    centers_w, rays_w = T_wc[:, :, None, :3, 3], rays_c @ T_wc[..., :3, :3].mT
    assert bool((centers_w.abs() < HALF).all()), "a camera outside of the room"
    depth = ((HALF * rays_w.sign() - centers_w) / rays_w).nan_to_num(nan=torch.inf).amin(dim=-1)
    return transform(T_wc, depth[..., None] * rays_c), depth
