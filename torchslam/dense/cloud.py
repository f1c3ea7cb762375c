"""A cloud of points with normals, colors and confidence."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, UInt8
from torch import Tensor


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
