"""What does not move with the scene: logos, subtitles, dirt on the lens, a part of the car.

A pixel stays in place although the camera moved so much that no point of the scene would have: seen twice in different
stretches of the way, it is left out of everything from then on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.config import MatchingConfig, StaticOverlayConfig
from torchslam.features import match_by_projection
from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.tracking.matcher import max_distance
from torchslam.types import FrameFeatures

_DEPTHS = (0.3, 1.0, 3.0, 30.0)  # of the scene's median depth: where the points of a scene lie
_SAMPLE = 8  # every so many-th keypoint is asked first whether the camera moved far enough to tell
_PAUSE = 4  # frames that are not compared after one in which nothing stayed


@dataclass(frozen=True)
class _Look:
    """A frame to compare later ones with.

    view:     what it saw; T_wc: (4, 4) where it was
    pixels:   (n, 2) of its keypoints
    points_c: (d, n, 3) where the points of these may be, by their depth
    """

    view: FrameFeatures
    T_wc: Tensor
    pixels: Tensor
    points_c: Tensor

    @classmethod
    def of(cls, view: FrameFeatures, T_cw: Tensor, depth: float, camera: Camera) -> _Look:
        pixels = view.keypoints[view.mask]
        rays = camera.unproject(pixels)
        depths = depth * rays.new_tensor(_DEPTHS)
        return cls(view, se3_inverse(T_cw), pixels, rays / rays[:, 2:] * depths[:, None, None])


class StaticOverlayDetector:
    """Collects evidence of pixels that stay, cell by cell."""

    def __init__(self, camera: Camera, settings: StaticOverlayConfig, matching: MatchingConfig) -> None:
        self.camera = camera
        self.settings = settings
        self.matching = matching
        width, height = camera.size
        shape = (int(height // settings.cell_px) + 1, int(width // settings.cell_px) + 1)
        self.evidence = torch.zeros(shape, dtype=torch.int64, device=camera.params.device)
        self._last: _Look | None = None
        self._pause = 0

    def mask_out(self, view: FrameFeatures) -> FrameFeatures:
        """The view without the keypoints that are known to stay."""
        if not bool((self.evidence >= self.settings.min_evidence).any()):
            return view
        return replace(view, mask=view.mask & ~self.covers(view.keypoints))

    def covers(self, pixels: Tensor) -> Tensor:
        """(n,) bool: pixels (n, 2) that are known to stay."""
        row, column = self._cells(pixels)
        return self.evidence[row, column] >= self.settings.min_evidence

    def observe(self, view: FrameFeatures, T_cw: Tensor, depth: float) -> int:
        """Compare a posed frame with an earlier one; returns how many cells became known to stay.

        view: with all its keypoints; T_cw: (4, 4); depth: median depth of the scene
        """
        last = self._last
        if last is None or view.session != last.view.session:
            self._last = _Look.of(view, T_cw, depth, self.camera)
            return 0
        self._pause -= 1
        if self._pause >= 0 or not self._is_far(self._must_move(last, T_cw, _SAMPLE)):
            return 0
        moving = self._must_move(last, T_cw)
        if not self._is_far(moving):
            return 0
        must_move = view.mask.new_zeros(len(last.view.mask))
        must_move[last.view.mask] = moving
        self._last = _Look.of(view, T_cw, depth, self.camera)
        stayed = self._stayed(last.view, view, must_move)
        before = int((self.evidence >= self.settings.min_evidence).sum())
        if len(stayed) < self.settings.min_keypoints:
            self.evidence[self.evidence < self.settings.min_evidence] = 0
            self._pause = _PAUSE
            return 0
        self._add(stayed)
        return int((self.evidence >= self.settings.min_evidence).sum()) - before

    def add(self, pixels: Tensor) -> None:
        """Evidence from elsewhere: pixels (m, 2) that stayed while the scene moved."""
        if self.settings.enabled and len(pixels) >= self.settings.min_keypoints:
            self._add(pixels)

    def _must_move(self, last: _Look, T_cw: Tensor, step: int = 1) -> Tensor:
        """(n,) whether a point of the scene seen at a keypoint, every `step`-th of them, moved, whatever its depth."""
        moved, valid = self.camera.project(transform(T_cw @ last.T_wc, last.points_c[:, ::step]))
        distance = distances_to_segments(last.pixels[::step], moved[:-1], moved[1:])
        return distance.where(valid[:-1] & valid[1:], torch.inf).amin(0) > self.settings.min_motion_px

    def _is_far(self, must_move: Tensor) -> bool:
        """Whether the camera moved far enough to tell: enough of some keypoints (n,) bool had to move."""
        return int(must_move.sum()) >= self.settings.min_moving_ratio * len(must_move)

    def forget_last(self) -> None:
        """The next frame cannot be compared with the ones before: its pose is in another world."""
        self._last = None

    def _stayed(self, earlier: FrameFeatures, view: FrameFeatures, candidates: Tensor) -> Tensor:
        """(m, 2) pixels of the candidates (N,) among the keypoints of an earlier view that look the same now."""
        rows = torch.nonzero(candidates)[:, 0]
        matches = match_by_projection(
            earlier.descriptors[rows][None],
            earlier.keypoints[rows][None],
            self.settings.radius_px,
            view.features,
            scales=earlier.scales[rows][None],
            max_distance=self.settings.max_distance_ratio * max_distance(view.descriptors, self.matching),
            ratio=None,
        )
        return view.keypoints[matches.indices_2[0][matches.mask[0]]]

    def _add(self, pixels: Tensor) -> None:
        """One more piece of evidence for the cells of pixels (m, 2) and those around them, each cell once."""
        row, column = self._cells(pixels)
        hit = torch.zeros_like(self.evidence)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                hit[(row + down).clamp(0, hit.shape[0] - 1), (column + right).clamp(0, hit.shape[1] - 1)] = 1
        self.evidence += hit

    def _cells(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        cells = torch.div(pixels, self.settings.cell_px, rounding_mode="floor").long()
        rows, columns = self.evidence.shape
        return cells[:, 1].clamp(0, rows - 1), cells[:, 0].clamp(0, columns - 1)


def distances_to_segments(points: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """(...) distances of points (..., 2) from the segments between starts and ends (..., 2)."""
    along = ends - starts
    length = (along * along).sum(-1).clamp(min=1e-12)
    share = (((points - starts) * along).sum(-1) / length).clamp(0, 1)
    return torch.linalg.vector_norm(points - starts - share[..., None] * along, dim=-1)
