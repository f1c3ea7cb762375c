"""What moves by itself: someone who walks past, a hand, a car. Its keypoints are left out while it is in view.

Two frames some way apart are matched by their descriptors alone. A point of a scene that stands still must appear on
the segment between its nearest and its farthest possible depth; matches that do not, and that one rigid motion
explains, belong to something else. From there on it is followed from frame to frame, without a pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.config import IndependentMotionConfig, MatchingConfig
from torchslam.features import match_by_projection
from torchslam.geometry import Camera, estimate_relative_pose, se3_inverse, transform
from torchslam.tracking.correspondences import match_views
from torchslam.tracking.dynamic.static_overlay import distances_to_segments
from torchslam.tracking.match_selection import cells
from torchslam.tracking.matcher import max_distance
from torchslam.types import FrameFeatures, PoseEstimate

_DEPTHS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 3.0, 30.0, 1000.0)  # of the scene's median depth
_NEIGHBOURS = 3  # of a keypoint that say whether it belongs
# Comparisons in which what was seen to move, and what is only near it, may agree with the map.
_PATIENCE, _LESS = 10, 3
_REACH = 0.06  # of the image's width: what is further from all that is known to belong does not


@dataclass(frozen=True)
class _Look:
    """A frame to compare later ones with: what it saw, where it was if that is known, how deep the scene was, and
    for how many more comparisons its keypoints (N,) int64 are taken to belong to what moves."""

    view: FrameFeatures
    T_cw: Tensor | None
    depth: float
    patience: Tensor


@dataclass(frozen=True)
class _Mover:
    """What moves by itself, in the last frame: its keypoints, those of the rest, and how it moved last.

    belongs: (N,) bool, which of the frame's keypoints are its
    pixels: (m, 2); descriptors: (m, D); scales: (m,); rest: (n, 2) pixels; motion: (2,) pixels a frame
    """

    belongs: Tensor
    pixels: Tensor
    descriptors: Tensor
    scales: Tensor
    rest: Tensor
    motion: Tensor

    @classmethod
    def of(cls, view: FrameFeatures, belongs: Tensor, motion: Tensor) -> _Mover:
        rows = torch.nonzero(view.mask & belongs)[:, 0]
        rest = view.keypoints[view.mask & ~belongs]
        return cls(belongs, view.keypoints[rows], view.descriptors[rows], view.scales[rows], rest, motion)


@dataclass(frozen=True)
class Movement:
    """What was seen to move by itself, in words, and whether the pose is in doubt for it; empty for nothing."""

    is_doubt: bool = False
    words: str = ""


NOTHING = Movement()


class IndependentMotion:
    """Watches for one group of keypoints that moves against the scene, and follows it."""

    def __init__(self, camera: Camera, settings: IndependentMotionConfig, matching: MatchingConfig) -> None:
        self.camera = camera
        self.settings = settings
        self.matching = matching
        self._mover: _Mover | None = None
        self._last: _Look | None = None  # with the keypoints that belonged then
        self._since = 0  # frames after the last look
        self._unseen = 0  # frames since it was seen to move against the scene

    def forget_last(self) -> None:
        """The next frame cannot be compared with the ones before by its pose, which is in another world."""
        if self._last is not None:
            self._last = replace(self._last, T_cw=None)

    def mask_out(self, view: FrameFeatures) -> FrameFeatures:
        """The view without the keypoints of what moves, which is followed to where it is now."""
        self._since += 1
        self._unseen += 1
        if self._mover is not None:
            self._mover = self._followed(self._mover, view)
        if self._mover is not None and self._since >= 2 * self.settings.frame_interval:
            self._look_again(view, None, 0.0)  # nobody knows where the camera is
        if self._mover is None:
            return view
        return replace(view, mask=view.mask & ~self._mover.belongs)

    def observe(self, view: FrameFeatures, estimate: PoseEstimate) -> Movement:
        """Compare a posed frame with one some frames earlier; in doubt where the map agrees with little of the image.

        view: with all its keypoints
        """
        mover, seen = self._mover, view.keypoints[estimate.keypoints]
        if mover is not None and self._area(mover.pixels) > self.settings.max_area_ratio * self._area(seen):
            return Movement(True, "most of the image moves by itself")
        if self._last is None or self._since >= self.settings.frame_interval:
            return self._look_again(view, estimate.T_cw, estimate.depth)
        return NOTHING

    def _followed(self, mover: _Mover, view: FrameFeatures) -> _Mover | None:
        """Where it is in the next frame, by how it looks; None when it is gone, or not seen to move for long."""
        matches = match_by_projection(
            mover.descriptors[None],
            (mover.pixels + mover.motion)[None],
            self.settings.search_px,
            view.features,
            scales=mover.scales[None],
            max_distance=max_distance(view.descriptors, self.matching),
        )
        found = matches.mask[0]
        if int(found.sum()) < self.settings.min_matches or self._unseen > self.settings.max_unseen_frames:
            return None
        motion = (view.keypoints[matches.indices_2[0][found]] - mover.pixels[found]).median(0).values
        return _Mover.of(view, self._nearer_to(view.keypoints, mover.pixels + motion, mover.rest), motion)

    def _look_again(self, view: FrameFeatures, T_cw: Tensor | None, depth: float) -> Movement:
        """Compare with the last look: what moves against the scene, and what of the mover moves as one."""
        last = self._last
        nobody = torch.zeros_like(view.mask, dtype=torch.int64)
        guess = nobody if self._mover is None else _LESS * self._mover.belongs
        look = _Look(view, T_cw, depth, guess)
        self._last, self._since = look, 0
        if last is None or view.session != last.view.session:
            return NOTHING
        frames = view.index - last.view.index
        first, second = match_views(last.view, view, self.matching)
        strays = self._errors(last, look, first, second) > self.settings.min_error_px
        patience = last.patience[first] - int(T_cw is not None and last.T_cw is not None)
        known = ~strays & (patience > 0)
        moving = self._together(last.view, view, first, second, strays)
        group = torch.cat([moving, self._together(last.view, view, first, second, known)])
        if len(group) == 0:
            self._mover, self._last = None, replace(look, patience=nobody)
            return NOTHING
        to, fro = view.keypoints[second], last.view.keypoints[first]
        if len(moving) and self._is_turned(to, moving, strays, last.patience[first] > 0):
            return Movement(True, f"{len(moving)} matches in the rest of the image move against the map")
        rest = torch.ones_like(strays)
        rest[group] = False
        belongs = self._nearer_to(view.keypoints, to[group], to[rest])
        # What agrees with the map beside it goes with it only as long as nobody knows where the camera is.
        beside = belongs[second].to(patience.dtype)
        renewed = torch.where(strays, _PATIENCE, patience).where(~rest, beside)
        patience = (_LESS * belongs).index_put((second,), renewed)
        self._mover = _Mover.of(view, belongs, (to - fro)[group].median(0).values / frames)
        self._last = replace(look, patience=patience)
        if len(moving) == 0:
            return NOTHING
        self._unseen = 0
        return Movement(
            False, f"{int((belongs & view.mask).sum())} keypoints move by themselves and are left out"
        )

    def _is_turned(self, pixels: Tensor, group: Tensor, strays: Tensor, known: Tensor) -> bool:
        """Whether the map may have gone over to what moves, so that the group is the scene: if what was known to move
        agrees with the map now, or else if the group has more of the image than what agrees.

        pixels: (n, 2) of all matches; group: (m,) rows; strays, known: (n,) bool
        """
        if bool(known[group].double().mean() >= 0.5):
            return False
        if bool(known.any()):
            return 2 * int(strays[known].sum()) < int(known.sum())
        return self._area(pixels[group]) > self._area(pixels[~strays])

    def _area(self, pixels: Tensor) -> int:
        """How many cells of the image pixels (n, 2) lie in."""
        return len(torch.unique(cells(pixels, self.camera.size)))

    def _errors(self, last: _Look, look: _Look, first: Tensor, second: Tensor) -> Tensor:
        """(n,) pixels, in units of the keypoints' noise, by which matches miss where a point of the scene can be;
        zero where the poses are unknown."""
        seen, view = last.view, look.view
        if last.T_cw is None or look.T_cw is None:
            return seen.keypoints.new_zeros(len(first))
        rays = self.camera.unproject(seen.keypoints[first])
        depths = last.depth * rays.new_tensor(_DEPTHS)
        points_c = rays / rays[:, 2:] * depths[:, None, None]
        pixels, valid = self.camera.project(transform(look.T_cw @ se3_inverse(last.T_cw), points_c))
        distances = distances_to_segments(view.keypoints[second], pixels[:-1], pixels[1:])
        errors = distances.where(valid[:-1] & valid[1:], torch.inf).amin(0)
        return errors / torch.maximum(seen.noise.tolerance[first], view.noise.tolerance[second])

    def _together(
        self, earlier: FrameFeatures, view: FrameFeatures, first: Tensor, second: Tensor, among: Tensor
    ) -> Tensor:
        """(m,) rows of the matches (n,), (n,) that one rigid motion explains, if it explains enough of those among
        (n,) bool."""
        rows = torch.nonzero(among)[:, 0]
        if len(rows) < self.settings.min_matches:
            return rows[:0]
        motion = estimate_relative_pose(
            earlier.keypoints[first[rows]][None],
            view.keypoints[second[rows]][None],
            self.camera,
            self.camera,
            threshold=self.settings.threshold_px,
            kernel="truncated",
            min_samples=64,
        )
        group = rows[motion.inliers[0]]
        enough = max(self.settings.min_matches, self.settings.min_outlier_ratio * len(rows))
        return group if len(group) >= enough else rows[:0]

    def _nearer_to(self, pixels: Tensor, group: Tensor, rest: Tensor) -> Tensor:
        """(n,) bool: whether most of the nearest neighbours of pixels (n, 2), and one within reach, are of a group
        (g, 2), not of the rest (r, 2)."""
        both = torch.cat([group, rest])
        k = min(_NEIGHBOURS, len(both))
        distances, nearest = torch.cdist(pixels, both).topk(k, largest=False)
        is_group = nearest < len(group)
        reach = distances.where(is_group, torch.inf).amin(-1) < _REACH * self.camera.width
        return reach & (2 * is_group.sum(-1) > k)
