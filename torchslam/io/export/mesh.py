"""A triangle mesh of the surfaces, fused from depth maps by Open3D (extra `mesh`).

The maps are averaged in a truncated signed distance function on a sparse grid of voxels (Curless and Levoy, 1996), of
which the mesh is the zero level (marching cubes).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.dense.depth_maps import DepthMaps
from torchslam.errors import ResultsError
from torchslam.geometry import se3_inverse
from torchslam.io.export.depths import depth_images
from torchslam.io.export.scene import Images

MIN_CONFIDENCE = 0.5
"""Depth of less confidence is left out."""
VOXEL_PX = 2.0
"""Size of a voxel in pixels at the median depth: what is finer, a depth map does not show."""
TRUNCATION = 4.0  # voxels to either side of a surface
DEPTH_STD = 0.01  # relative, of a depth of enough confidence; surfaces that differ by two of them are one
FARTHEST = 5.0  # median depths: what is farther has no detail left
MIN_TRIANGLES = 100  # of a connected part: smaller ones are errors of depth
UNPAINTED = 180  # gray, without images


@dataclass(frozen=True)
class MeshSize:
    """voxel: side of a voxel, map units; vertices, triangles: numbers in the file."""

    voxel: float
    vertices: int
    triangles: int


def import_open3d() -> ModuleType:
    """Import Open3D. Raises ResultsError with an installation hint if it is missing."""
    try:
        import open3d
    except ImportError as error:
        raise ResultsError(
            f"Open3D is required for a mesh: pip install 'torchslam[mesh]' ({error})"
        ) from None
    return open3d


def write_mesh(path: Path, depths: Path, R_up: Float[Tensor, "3 3"], images: Images | None) -> MeshSize:
    """Write the mesh of the surfaces as PLY, with normals and colors.

    Args:
        path: the file to write.
        depths: the file of the depth maps.
        R_up: rotation from the map's world to that of the mesh.
        images: of the camera of the depth maps; None: gray.

    Raises:
        ResultsError: Open3D is missing, or no depth has enough confidence.
    """
    o3d = import_open3d()
    middle = _median_depth(depths)
    first = next(depth_images(depths)).camera
    voxel = VOXEL_PX * middle / float(first.params[0])
    volume = o3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=voxel,
        sdf_trunc=max(TRUNCATION * voxel, 2 * DEPTH_STD * middle),
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.RGB8,
    )
    fx, fy, cx, cy = first.params.tolist()
    intrinsic = o3d.camera.PinholeCameraIntrinsic(first.width, first.height, fx, fy, cx, cy)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = R_up
    for maps in depth_images(depths):
        picture = o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(_color(maps, images)),
            o3d.geometry.Image(np.ascontiguousarray(_sure_depth(maps).numpy())),
            depth_scale=1.0,
            depth_trunc=FARTHEST * middle,
            convert_rgb_to_intensity=False,
        )
        T_cu = maps.T_cw[0].double() @ se3_inverse(turn)
        volume.integrate(picture, intrinsic, T_cu.numpy())
    mesh = volume.extract_triangle_mesh()
    part, counts, _ = mesh.cluster_connected_triangles()
    mesh.remove_triangles_by_mask(np.asarray(counts)[np.asarray(part)] < MIN_TRIANGLES)
    mesh.remove_unreferenced_vertices()
    mesh.compute_vertex_normals()
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise ResultsError(f"{path}: cannot be written")
    return MeshSize(voxel, len(mesh.vertices), len(mesh.triangles))


def _sure_depth(maps: DepthMaps) -> Float[Tensor, "H W"]:
    """The depth of one map, 0 where it has too little confidence."""
    return torch.where(maps.confidence[0] >= MIN_CONFIDENCE, maps.depth[0], 0.0).float()


def _median_depth(depths: Path) -> float:
    """The median over the maps of their median depths. Raises ResultsError without any depth."""
    seen = [depth[depth > 0] for depth in map(_sure_depth, depth_images(depths))]
    medians = [each.median() for each in seen if len(each)]
    if not medians:
        raise ResultsError(f"{depths}: no depth of a confidence of {MIN_CONFIDENCE} or more")
    return float(torch.stack(medians).median())


def _color(maps: DepthMaps, images: Images | None) -> np.ndarray:
    """The image of a map, (H, W, 3) red, green, blue."""
    if images is None:
        return np.full((*maps.depth.shape[1:], 3), UNPAINTED, np.uint8)
    return cv2.cvtColor(images.bgr(int(maps.frame_index)), cv2.COLOR_BGR2RGB)
