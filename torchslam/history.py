"""What a run remembers of every posed frame: where it was, and which points it saw at which pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_inverse
from torchslam.map import Map
from torchslam.solvers import refine_pose
from torchslam.table import Table
from torchslam.tracking import Tracked
from torchslam.types import Trajectory, View


class History:
    """Poses relative to a keyframe, so that they follow when the map is adjusted; observations as flat rows."""

    def __init__(self) -> None:
        self.frames = Table()
        self.observations = Table()

    def add(self, view: View, tracked: Tracked, T_cr: Tensor, reference: int) -> None:
        """Remember a posed frame: its pose T_cr (4, 4) relative to keyframe `reference`, and what it saw."""
        device = T_cr.device
        row = self.frames.append(
            frame_index=torch.tensor([view.index], device=device),
            timestamp=torch.tensor([view.timestamp], dtype=torch.float64, device=device),
            T_cr=T_cr[None],
            reference=torch.tensor([reference], device=device),
        )
        self.observations.append(
            row=row.expand(tracked.inliers),
            point_ids=tracked.point_ids,
            keypoints=tracked.keypoints,
            pixels=view.keypoints[tracked.keypoints],
            scales=view.scales[tracked.keypoints],
        )

    def __len__(self) -> int:
        return len(self.frames)

    def T_cw(self, slam_map: Map) -> Tensor:
        """(F, 4, 4) poses of the frames in the order they were added, by the map as it is now."""
        return self.frames["T_cr"] @ slam_map.T_cw[self.frames["reference"]]

    def trajectory(self, slam_map: Map) -> Trajectory:
        """Camera to world, ordered by time."""
        if len(self) == 0:
            return Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
        timestamps = self.frames["timestamp"]
        order = torch.argsort(timestamps, stable=True)
        return Trajectory(timestamps[order].clone(), se3_inverse(self.T_cw(slam_map)[order]))

    def repose(self, slam_map: Map, camera: Camera, frames_at_once: int = 128) -> None:
        """Refine every frame against the map as it is now, in batches: the map moved after the frame was tracked.

        A frame that sees fewer than ten points that are still alive keeps its pose relative to its keyframe.
        """
        seen = self.observations
        ids = slam_map.resolve(seen["point_ids"])
        alive = slam_map.points["alive"][ids]
        counts = torch.bincount(seen["row"], minlength=len(self))
        starts = counts.cumsum(0) - counts
        T_cw = self.T_cw(slam_map)
        for first in range(0, len(self), frames_at_once):
            rows = slice(first, min(first + frames_at_once, len(self)))
            slot = torch.arange(int(counts[rows].max()), device=ids.device)
            mask = slot < counts[rows, None]
            index = torch.where(mask, starts[rows, None] + slot, 0)
            mask &= alive[index]
            refined = refine_pose(
                T_cw[rows],
                slam_map.positions_w[ids[index]],
                seen["pixels"][index],
                camera,
                weights=seen["scales"][index] ** -2,
                mask=mask,
                kernel="huber",
                scale=2.0,
                backward="detached",
            )
            is_better = refined.success & (mask.sum(1) >= 10)
            moved = refined.T_cw @ se3_inverse(slam_map.T_cw[self.frames["reference"][rows]])
            self.frames["T_cr"][rows] = torch.where(
                is_better[:, None, None], moved, self.frames["T_cr"][rows]
            )
