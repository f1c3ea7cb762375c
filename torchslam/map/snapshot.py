"""A map as it was before keyframes were added to it, so that they can be taken back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.map.map import Map

CHANGES = ("T_cw", "covariances", "information", "point_ids")
"""The columns of a keyframe that later ones may change; what it saw stays as it is."""


@dataclass(frozen=True)
class MapSnapshot:
    """What of a map later keyframes may change: columns of its points and keyframes, copied. It knows its map's rows,
    so that these must not be renumbered until it is returned to."""

    points: dict[str, Tensor]
    keyframes: dict[str, Tensor]

    @classmethod
    @torch.inference_mode(False)
    def of(cls, slam_map: Map) -> MapSnapshot:
        """A map with at least one keyframe, as it is now."""
        points, keyframes = slam_map.points, slam_map.keyframes
        return cls(
            {name: column.clone() for name, column in points.columns().items()},
            {name: keyframes[name].clone() for name in CHANGES},
        )

    @property
    def num_keyframes(self) -> int:
        """How many there were."""
        return len(self.keyframes["T_cw"])

    def return_to(self, slam_map: Map) -> None:
        """Put the map to where it was."""
        for key in slam_map.keys[self.num_keyframes :].tolist():
            slam_map.images.pop(key, None)
        slam_map.points.cut(len(self.points["is_valid"]))
        slam_map.keyframes.cut(self.num_keyframes)
        for table, columns in ((slam_map.points, self.points), (slam_map.keyframes, self.keyframes)):
            for name, column in columns.items():
                table[name][:] = column
        slam_map.reindex()
