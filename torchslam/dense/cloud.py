"""A cloud of points with normals, colors and confidence, and its fusion from depth maps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchslam.dense.depth_maps import DepthMaps
from torchslam.geometry import se3_inverse, transform

MERGE_AT = 1 << 20
"""Points that are collected before equal voxels are summed."""
MAX_CELL = 1 << 20
"""Of a voxel's coordinates, so that three of them fit into 63 bits."""


@dataclass(frozen=True)
class PointCloud:
    """Points of surfaces in the world frame of a map.

    Attributes:
        points_w: positions, map units.
        normals_w: unit normals, facing the cameras that saw the point.
        colors: red, green, blue.
        confidence: 0 to 1, as of the depth maps.
    """

    points_w: Float[Tensor, "N 3"]
    normals_w: Float[Tensor, "N 3"]
    colors: UInt8[Tensor, "N 3"]
    confidence: Float[Tensor, " N"]

    def __len__(self) -> int:
        return len(self.points_w)

    def __getitem__(self, rows: Int[Tensor, " R"] | Bool[Tensor, " N"]) -> PointCloud:
        """Return some of the points."""
        return PointCloud(self.points_w[rows], self.normals_w[rows], self.colors[rows], self.confidence[rows])

    def turned(self, R: Float[Tensor, "3 3"]) -> PointCloud:
        """Return the cloud rotated by R: points p become R p."""
        R = R.to(self.points_w)
        return replace(self, points_w=self.points_w @ R.mT, normals_w=self.normals_w @ R.mT)

    def thinned(self, limit: int) -> PointCloud:
        """Return at most `limit` points, chosen at random with a fixed seed.

        Neighboring rows are neighboring pixels, so that every n-th row would leave stripes.
        """
        if len(self) <= limit:
            return self
        generator = torch.Generator().manual_seed(0)
        rows = torch.randperm(len(self), generator=generator, device="cpu")[:limit].sort().values
        return self[rows.to(self.points_w.device)]

    def spacing(self) -> float:
        """Return the median distance of points to their third neighbor, of up to 200 points; 0 for very few points.

        On a surface, a circle of that radius holds as many points.
        """
        if len(self) <= 3:
            return 0.0
        points_w = self.points_w.float()
        rows = torch.linspace(0, len(self) - 1, min(len(self), 200), dtype=torch.float32, device="cpu").long()
        distances = torch.cdist(points_w[rows.to(points_w.device)], points_w)
        return float(distances.topk(4, dim=1, largest=False).values[:, -1].median())


class CloudFusion:
    """Fuse depth maps, block after block, into one cloud.

    A point of the cloud is the mean of all points in its voxel, weighted by confidence. Memory grows with the number of
    voxels, not with that of the maps.

    Args:
        voxel: edge of the voxels, map units: as large as the depth is uncertain.
    """

    def __init__(self, voxel: float) -> None:
        self._voxel = voxel
        self._pending: list[tuple[Tensor, Tensor]] = []  # keys and sums of voxels

    def add(self, maps: DepthMaps, colors: UInt8[Tensor, "K H W 3"]) -> None:
        """Add the known pixels of depth maps that have a normal, with their colors."""
        for row in range(len(maps)):
            self._add(maps, row, colors[row])

    def cloud(self) -> PointCloud:
        """Return the cloud, ordered by voxel."""
        if not self._pending:
            nothing = torch.zeros(0, 3, dtype=torch.float32, device="cpu")
            return PointCloud(nothing, nothing, nothing.byte(), nothing[:, 0])
        self._merge()
        sums = self._pending[0][1]
        mean = sums[:, 1:] / sums[:, :1]
        return PointCloud(
            points_w=mean[:, :3].float(),
            normals_w=torch.nn.functional.normalize(mean[:, 3:6], dim=1).float(),
            colors=mean[:, 6:9].round().to(torch.uint8),
            confidence=mean[:, 9].float(),
        )

    def _add(self, maps: DepthMaps, row: int, colors: Tensor) -> None:
        from kornia.geometry.depth import depth_to_3d_v2  # 0.2 s of processor time, which few runs need

        depth, normal = maps.depth[row].double(), maps.normal[row].double()
        is_used = (depth > 0) & (normal != 0).any(0) & (maps.confidence[row] > 0)
        y, x = torch.nonzero(is_used, as_tuple=True)
        points_c = depth_to_3d_v2(depth[None], maps.camera.K.to(depth)[None])[0, y, x]
        T_wc = se3_inverse(maps.T_cw[row]).to(depth)
        points_w = transform(T_wc, points_c)
        normals_w = normal[:, y, x].mT @ T_wc[:3, :3].mT
        confidence = maps.confidence[row].double()[y, x, None]
        values = torch.cat((points_w, normals_w, colors[y, x].to(depth), confidence), dim=1)
        sums = torch.cat((confidence, confidence * values), dim=1)
        self._pending.append(_sum_equal(_voxel_keys(points_w, self._voxel), sums))
        # Not every time, so that the cost of all is that of sorting a few times as many.
        if sum(len(keys) for keys, _ in self._pending[1:]) > max(MERGE_AT, len(self._pending[0][0])):
            self._merge()

    def _merge(self) -> None:
        keys, sums = zip(*self._pending, strict=True)
        self._pending = [_sum_equal(torch.cat(keys), torch.cat(sums))]


def _sum_equal(
    keys: Int[Tensor, " N"], rows: Float[Tensor, "N 11"]
) -> tuple[Int[Tensor, " R"], Float[Tensor, "R 11"]]:
    """Sum the rows of equal keys; the keys are ascending."""
    unique, place = torch.unique(keys, return_inverse=True)
    return unique, rows.new_zeros(len(unique), rows.shape[1]).index_add(0, place, rows)


def _voxel_keys(points_w: Float[Tensor, "N 3"], voxel: float) -> Int[Tensor, " N"]:
    """A number for the voxel of each point; far from the origin, voxels share the last one."""
    cell = (points_w / voxel).floor().clamp(-MAX_CELL, MAX_CELL - 1).long() + MAX_CELL
    return (cell[:, 0] * (2 * MAX_CELL) + cell[:, 1]) * (2 * MAX_CELL) + cell[:, 2]
