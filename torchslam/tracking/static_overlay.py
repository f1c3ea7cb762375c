"""Detection of static overlays: logos, subtitles, dirt on the lens, a part of the car.

Evidence is a keypoint that stays at its pixel although the camera moved so far that every point of the scene would have
moved. Pixels with evidence from two different camera motions are masked out from then on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.features import match_by_projection
from torchslam.geometry import Camera, SharedCamera, se3_inverse, transform
from torchslam.tracking.matcher import max_distance
from torchslam.types import FrameFeatures

MIN_MOTION_PX = 4.0
"""Image motion that a point of the scene must have had between the compared frames, pixels of reduced images. Tried at
this value only."""
MIN_MOVING_RATIO = 0.5
"""Ratio of the keypoints that must have moved before two frames are compared. Tried at this value only."""
RADIUS_PX = 1.5
"""Distance within which a keypoint counts as not having moved, pixels of reduced images. Tried at this value only."""
CELL_PX = 4.0
"""Size of the cells that accumulate evidence, pixels of reduced images: corners move slightly under noise. Tried at
this value only."""
MAX_DISTANCE_RATIO = 0.6
"""Largest descriptor distance, relative to the limit of ordinary matching. Tried at this value only."""
MIN_KEYPOINTS = 8
"""Static keypoints below which they are a coincidence. Tried at this value only."""
MIN_EVIDENCE = 2
"""Comparisons in which a cell must have been static before it is masked. Tried at this value only."""
_DEPTHS = (0.3, 1.0, 3.0, 30.0)
"""Possible depths of a keypoint, relative to the scene's median depth; fewer than for moving objects, as only those
keypoints count that move far whatever their depth. Tried at these values only."""
_STRIDE = 8
"""Every so many keypoints are in the first test whether the camera moved far enough; it saves time only."""
_PAUSE = 4
"""Frames without a comparison after one that found no overlay; it saves time only."""


@dataclass(frozen=True)
class _Reference:
    """A posed frame, with all its keypoints, to compare later ones with, and their points at the possible depths."""

    view: FrameFeatures
    T_wc: Float[Tensor, "4 4"]
    pixels: Float[Tensor, "N 2"]
    points_c: Float[Tensor, "D N 3"]
    world: tuple[int, int]

    @classmethod
    def of(
        cls,
        view: FrameFeatures,
        T_cw: Float[Tensor, "4 4"],
        depth: float,
        world: tuple[int, int],
        camera: Camera,
    ) -> _Reference:
        pixels = view.keypoints[view.mask]
        return cls(view, se3_inverse(T_cw), pixels, points_at_depths(camera, pixels, depth, _DEPTHS), world)


class StaticOverlayDetector:
    """Collects evidence of static overlays in a grid of image cells."""

    def __init__(self, camera: SharedCamera, config: Config) -> None:
        self.camera = camera
        self.matching = config.matching
        width, height = camera.current.size
        self.reduction = config.features.reduction((width, height))
        self.cell_px = CELL_PX * self.reduction
        shape = (int(height // self.cell_px) + 1, int(width // self.cell_px) + 1)
        self.evidence = torch.zeros(shape, dtype=torch.int64, device=camera.current.params.device)
        self._last: _Reference | None = None
        self._pause = 0

    def mask_out(self, view: FrameFeatures) -> FrameFeatures:
        """The view without the keypoints of known overlays."""
        if not bool((self.evidence >= MIN_EVIDENCE).any()):
            return view
        return replace(view, mask=view.mask & ~self.covers(view.keypoints))

    def covers(self, pixels: Float[Tensor, "N 2"]) -> Bool[Tensor, " N"]:
        """Which pixels belong to a known overlay."""
        row, column = self._cells(pixels)
        return self.evidence[row, column] >= MIN_EVIDENCE

    def observe(
        self, view: FrameFeatures, T_cw: Float[Tensor, "4 4"], depth: float, world: tuple[int, int] = (0, 0)
    ) -> int:
        """Compare a posed frame, with all its keypoints, with an earlier one; `world`: see `Submap.world`.

        Returns the number of cells that became known overlays.
        """
        last = self._last
        if last is None or view.session != last.view.session or last.world != world:
            self._last = _Reference.of(view, T_cw, depth, world, self.camera.current)
            return 0
        self._pause -= 1
        if self._pause >= 0 or not self._is_far(self._must_move(last, T_cw, _STRIDE)):
            return 0
        moving = self._must_move(last, T_cw)
        if not self._is_far(moving):
            return 0
        must_move = view.mask.new_zeros(len(last.view.mask))
        must_move[last.view.mask] = moving
        self._last = _Reference.of(view, T_cw, depth, world, self.camera.current)
        stayed = self._stayed(last.view, view, must_move)
        before = int((self.evidence >= MIN_EVIDENCE).sum())
        if len(stayed) < MIN_KEYPOINTS:
            self.evidence[self.evidence < MIN_EVIDENCE] = 0
            self._pause = _PAUSE
            return 0
        self._add(stayed)
        return int((self.evidence >= MIN_EVIDENCE).sum()) - before

    def add(self, pixels: Float[Tensor, "M 2"]) -> None:
        """Add evidence from another source: pixels that stayed in place while the scene moved."""
        if len(pixels) >= MIN_KEYPOINTS:
            self._add(pixels)

    def restore(self, evidence: Int[Tensor, "R C"]) -> None:
        """Continue from the evidence of a checkpoint."""
        self.evidence.copy_(evidence)

    def _must_move(self, last: _Reference, T_cw: Float[Tensor, "4 4"], step: int = 1) -> Bool[Tensor, " N"]:
        """Whether every `step`-th keypoint had to move if it belongs to the scene, whatever its depth."""
        points_c, pixels = last.points_c[:, ::step], last.pixels[::step]
        distances = distances_to_views(self.camera.current, T_cw @ last.T_wc, points_c, pixels)
        return distances > MIN_MOTION_PX * self.reduction

    def _is_far(self, must_move: Bool[Tensor, " N"]) -> bool:
        """Whether the camera moved far enough for a comparison: enough of the keypoints had to move."""
        return int(must_move.sum()) >= MIN_MOVING_RATIO * len(must_move)

    def _stayed(
        self, earlier: FrameFeatures, view: FrameFeatures, candidates: Bool[Tensor, " N"]
    ) -> Float[Tensor, "M 2"]:
        """Pixels in `view` of candidates, keypoints of an earlier view matched at their old pixel."""
        rows = torch.nonzero(candidates)[:, 0]
        there = earlier.features.rows(rows)
        matches = match_by_projection(
            there.descriptors,
            there.keypoints,
            RADIUS_PX * self.reduction,
            view.features,
            scales=there.scales,
            max_distance=MAX_DISTANCE_RATIO * max_distance(view.descriptors, self.matching),
            ratio=None,
        )
        return view.keypoints[matches.indices_2[0][matches.mask[0]]]

    def _add(self, pixels: Float[Tensor, "M 2"]) -> None:
        """Increment the evidence of the cells of pixels and of their neighbors, each cell once."""
        row, column = self._cells(pixels)
        hit = torch.zeros_like(self.evidence)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                hit[(row + down).clamp(0, hit.shape[0] - 1), (column + right).clamp(0, hit.shape[1] - 1)] = 1
        self.evidence += hit

    def _cells(self, pixels: Float[Tensor, "N 2"]) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"]]:
        """Rows and columns of `evidence` for pixels."""
        rows, columns = self.evidence.shape
        column, row = (pixels / self.cell_px).unbind(-1)
        return row.clamp(0, rows - 1).long(), column.clamp(0, columns - 1).long()


def points_at_depths(
    camera: Camera, pixels: Float[Tensor, "N 2"], depth: float, ratios: tuple[float, ...]
) -> Float[Tensor, "D N 3"]:
    """The points of pixels at depths relative to the one of the scene."""
    rays = camera.unproject(pixels)
    return rays / rays[:, 2:] * (depth * rays.new_tensor(ratios))[:, None, None]


def distances_to_views(
    camera: Camera, T_21: Float[Tensor, "4 4"], points_c: Float[Tensor, "D N 3"], pixels: Float[Tensor, "N 2"]
) -> Float[Tensor, " N"]:
    """Distances of pixels of another view from where it sees points between depths."""
    seen, valid = camera.project(transform(T_21, points_c))
    distances = distances_to_segments(pixels, seen[:-1], seen[1:])
    return distances.where(valid[:-1] & valid[1:], torch.inf).amin(0)


def distances_to_segments(
    points: Float[Tensor, "*#batch 2"], starts: Float[Tensor, "*#batch 2"], ends: Float[Tensor, "*#batch 2"]
) -> Float[Tensor, "*#batch"]:
    """Distances of points from the segments between starts and ends."""
    along = ends - starts
    length = (along * along).sum(-1).clamp(min=1e-12)
    share = (((points - starts) * along).sum(-1) / length).clamp(0, 1)
    return torch.linalg.vector_norm(points - starts - share[..., None] * along, dim=-1)
