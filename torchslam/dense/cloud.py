"""A cloud of points with normals, colors and confidence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

THINNING_SEED = 0
"""Of the choice of points, so that the same cloud is thinned to the same bytes."""
SPACING_SAMPLE = 200  # points whose distance to their neighbors is measured
SPACING_RANK = 3  # the neighbor at that distance: on a surface, a circle of that radius holds as many points


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
        generator = torch.Generator().manual_seed(THINNING_SEED)
        rows = torch.randperm(len(self), generator=generator, device="cpu")[:limit].sort().values
        return self[rows.to(self.points_w.device)]

    def spacing(self) -> float:
        """Return the median distance of points to their third neighbor; 0 for very few points."""
        if len(self) <= SPACING_RANK:
            return 0.0
        points_w = self.points_w.float()
        rows = torch.linspace(
            0, len(self) - 1, min(len(self), SPACING_SAMPLE), dtype=torch.float32, device="cpu"
        ).long()
        distances = torch.cdist(points_w[rows.to(points_w.device)], points_w)
        return float(distances.topk(SPACING_RANK + 1, dim=1, largest=False).values[:, -1].median())
