"""Scene for exports: posed frames of one run in one submap, their points and observations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.geometry import Camera, se3_inverse, squared_reprojection_errors, transform
from torchslam.map.atlas import Submap


@dataclass(frozen=True)
class Scene:
    """F posed frames in order of time, P points and O observations, ordered by frame; on the CPU.

    Attributes:
        frame_ids: (F,) in the sequence
        timestamps: (F,) seconds
        is_keyframe: (F,) bool
        T_cw: (F, 4, 4)
        points_w: (P, 3), each seen by two frames or more
        colors: (P, 3) uint8 red, green, blue
        frame_index, point_index: (O,)
        pixels: (O, 2) of the observed keypoints
    """

    camera: Camera
    frame_ids: Tensor
    timestamps: Tensor
    is_keyframe: Tensor
    T_cw: Tensor
    points_w: Tensor
    colors: Tensor
    frame_index: Tensor
    point_index: Tensor
    pixels: Tensor

    @property
    def T_wc(self) -> Tensor:
        """(F, 4, 4) camera to world."""
        return se3_inverse(self.T_cw)

    @property
    def image_names(self) -> list[str]:
        """Image file names of an export, in the order of the frames."""
        return [f"{index:06d}.png" for index in self.frame_ids.tolist()]

    def turned(self, R: Tensor) -> Scene:
        """Return the scene rotated by R (3, 3): points p become R p."""
        T_cw = self.T_cw.clone()
        T_cw[:, :3, :3] = T_cw[:, :3, :3] @ R.mT
        return replace(self, T_cw=T_cw, points_w=self.points_w @ R.mT)

    def errors(self) -> Tensor:
        """Return the reprojection errors (O,)."""
        points_c = transform(self.T_cw[self.frame_index], self.points_w[self.point_index][:, None])
        return squared_reprojection_errors(points_c[:, 0], self.pixels, self.camera).sqrt()

    def point_errors(self) -> Tensor:
        """Return the mean error (P,) of each point; their mean is the reprojection error of COLMAP."""
        total = torch.zeros(len(self.points_w), dtype=self.pixels.dtype)
        count = torch.bincount(self.point_index, minlength=len(total))
        return total.index_add(0, self.point_index, self.errors()) / count


def scene_of(submap: Submap, camera: Camera, session: int, keyframes_alone: bool) -> Scene:
    """Build the scene of one session in a saved submap, from all frames or only from keyframes.

    Points outside of the domain of the camera model and points with fewer than two observations are omitted. Raises
    ResultsError if there are no frames.
    """
    if submap.map.num_keyframes == 0:
        raise ResultsError(f"submap {submap.number} is empty")
    graph = submap.posed_frames.graph(submap.map, camera, submap.number)
    wanted = (graph.sessions == session) & (graph.is_keyframe | (not keyframes_alone))
    rows = torch.nonzero(wanted)[:, 0]
    if len(rows) == 0:
        raise ResultsError(
            f"submap {submap.number} holds no frames of this run: it was only localized, or all of it is elsewhere"
        )
    rows = rows[torch.argsort(graph.timestamps[rows], stable=True)]
    slot = torch.full((len(graph.T_cw),), -1).index_copy(0, rows, torch.arange(len(rows)))
    points_c = transform(graph.T_cw[graph.frame_index], graph.points_w[graph.point_index][:, None])
    is_kept = (slot[graph.frame_index] >= 0) & camera.project(points_c[:, 0])[1]
    tracks = torch.bincount(graph.point_index[is_kept], minlength=len(graph.points_w))
    is_kept &= tracks[graph.point_index] >= 2
    seen = torch.nonzero(is_kept)[:, 0]
    seen = seen[torch.argsort(slot[graph.frame_index[seen]], stable=True)]
    points, point_index = torch.unique(graph.point_index[seen], return_inverse=True)
    return Scene(
        camera=camera.to(torch.float64),
        frame_ids=graph.frame_ids[rows],
        timestamps=graph.timestamps[rows],
        is_keyframe=graph.is_keyframe[rows],
        T_cw=graph.T_cw[rows].double(),
        points_w=graph.points_w[points].double(),
        colors=submap.map.points["colors"][graph.point_ids[points]],
        frame_index=slot[graph.frame_index[seen]],
        point_index=point_index,
        pixels=graph.pixels[seen].double(),
    )
