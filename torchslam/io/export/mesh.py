"""A triangle mesh of the surfaces, fused from depth maps by Open3D (extra `mesh`).

The maps are averaged in a truncated signed distance function on a sparse grid of voxels (Curless and Levoy, 1996), of
which the mesh is the zero level (marching cubes).
"""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.dense.depth_maps import DepthMaps, read_frames
from torchslam.errors import ResultsError
from torchslam.geometry import rigid, se3_inverse, transform
from torchslam.io.export.scene import Images

MIN_CONFIDENCE = 0.5  # depth of less confidence is left out
VOXEL_PX = 2.0
"""Least width of a voxel in pixels at the median depth: what is finer, a depth map does not show."""
DEPTH_STD = 0.01
"""Relative error of a depth of enough confidence: the least width of a voxel in median depths."""
BLOCK = 8  # voxels to a side: memory is taken in blocks
MAX_BLOCKS = 50_000
"""Blocks with a surface: about 2 GB with the blocks beside it. In a larger scene, voxels are wider."""
BLOCK_STRIDE = 4  # pixels, of the depth that the blocks are counted from
FARTHEST = 5.0  # median depths: what is farther has no detail


class MeshSize(NamedTuple):
    """Width of a voxel in map units, and numbers in the file."""

    voxel: float
    vertices: int
    triangles: int


def import_open3d() -> ModuleType:
    """Import Open3D. Raises ResultsError with an installation hint if it is missing."""
    try:
        import open3d
    except ImportError as error:
        hint = "Open3D is required for a mesh: pip install 'torchslam[mesh]'"
        raise ResultsError(f"{hint} ({error})") from None
    return open3d


def write_mesh(path: Path, depths: Path, R_up: Float[Tensor, "3 3"], images: Images | None) -> MeshSize:
    """Write the mesh of the surfaces as PLY, with normals and colors; equal maps give equal bytes.

    Args:
        path: the file to write.
        depths: the file of the depth maps.
        R_up: rotation from the map's world to that of the mesh.
        images: of the camera of the depth maps; None: gray.

    Raises:
        ResultsError: Open3D is missing, or no depth has enough confidence.
    """
    o3d = import_open3d()
    turn = rigid(R_up.double(), torch.zeros(3, dtype=torch.float64, device="cpu"))
    middle, voxel = _middle_and_voxel(depths)
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3d.core.float32,) * 3,
        attr_channels=(1, 1, 3),
        voxel_size=voxel,
        block_resolution=BLOCK,
        block_count=10_000,  # that memory is taken for at once; there may be more
        device=o3d.core.Device("CPU:0"),
    )
    for maps in DepthMaps.blocks(depths, 1):
        depth = o3d.t.geometry.Image(o3d.core.Tensor(_sure_depth(maps, middle).numpy()))
        pixels = np.full((*maps.depth.shape[1:], 3), 180 / 255, np.float32)  # gray
        if images is not None:
            rgb = cv2.cvtColor(images.bgr(int(maps.frame_index)), cv2.COLOR_BGR2RGB)
            pixels = rgb.astype(np.float32) / 255
        color = o3d.t.geometry.Image(o3d.core.Tensor(pixels))
        K = o3d.core.Tensor(maps.camera.K.double().numpy())
        T_cu = o3d.core.Tensor((maps.T_cw[0].double() @ turn.mT).numpy())
        limits = (1.0, FARTHEST * middle, 4.0)  # scale, largest depth, voxels to either side of a surface
        blocks = grid.compute_unique_block_coordinates(depth, K, T_cu, *limits)
        grid.integrate(blocks, depth, color, K, T_cu, *limits)
    weight = min(2, len(read_frames(depths)[0]))  # maps that see a voxel
    mesh = grid.extract_triangle_mesh(weight_threshold=weight - 0.5).to_legacy()  # weights are whole
    part, counts, _ = mesh.cluster_connected_triangles()
    mesh.remove_triangles_by_mask(np.asarray(counts)[np.asarray(part)] < 100)  # errors of depth
    mesh.remove_unreferenced_vertices()
    if not mesh.triangles:
        raise ResultsError(f"{depths}: no surface that {weight} depth maps agree on")
    mesh = _ordered(o3d, mesh)
    mesh.compute_vertex_normals()
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise ResultsError(f"{path}: cannot be written")
    return MeshSize(voxel, len(mesh.vertices), len(mesh.triangles))


def _ordered(o3d: ModuleType, mesh: Any) -> Any:
    """The mesh with vertices and triangles in order: theirs depends on the threads of Open3D."""
    vertices, colors = np.asarray(mesh.vertices), np.asarray(mesh.vertex_colors).clip(0, 1)
    order = np.lexsort((*colors.T, *vertices.T))
    triangles = np.argsort(order)[np.asarray(mesh.triangles)]
    first = triangles.argmin(axis=1)[:, None]
    # Turning the corners keeps the side that is outside.
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    triangles = triangles[np.lexsort(triangles.T)]
    vector = o3d.utility.Vector3dVector
    ordered = o3d.geometry.TriangleMesh(vector(vertices[order]), o3d.utility.Vector3iVector(triangles))
    ordered.vertex_colors = vector(colors[order])
    return ordered


def _sure_depth(maps: DepthMaps, middle: float = math.inf) -> Float[Tensor, "H W"]:
    """The depth of one map, 0 where it has too little confidence or is too far."""
    depth = maps.depth[0].float()
    return torch.where((maps.confidence[0] >= MIN_CONFIDENCE) & (depth < FARTHEST * middle), depth, 0.0)


def _middle_and_voxel(depths: Path) -> tuple[float, float]:
    """The median over the maps of their median depths, and the width of a voxel: what they resolve, or memory allows.

    Raises ResultsError without any depth.
    """
    seen = [depth[depth > 0] for depth in map(_sure_depth, DepthMaps.blocks(depths, 1))]
    medians = [each.median() for each in seen if len(each)]
    if not medians:
        raise ResultsError(f"{depths}: no depth of a confidence of {MIN_CONFIDENCE} or more")
    middle, points = float(torch.stack(medians).median()), []
    for maps in DepthMaps.blocks(depths, 1):
        depth = _sure_depth(maps, middle)[::BLOCK_STRIDE, ::BLOCK_STRIDE].double()
        v, u = (BLOCK_STRIDE * index for index in torch.nonzero(depth).T)
        rays_c = maps.camera.to(torch.float64).unproject(torch.stack((u, v), dim=-1).double())
        points_c = rays_c / rays_c[:, 2:] * depth[depth > 0][:, None]
        points.append(transform(se3_inverse(maps.T_cw[0].double()), points_c))
    voxel = middle * max(DEPTH_STD, VOXEL_PX / float(maps.camera.params[0]))
    while len(torch.unique((torch.cat(points) / (BLOCK * voxel)).floor(), dim=0)) > MAX_BLOCKS:
        voxel *= 1.25
    return middle, voxel
