"""Keypoints that do not belong to the static scene: moving objects, found here, and static overlays.

A moving object, such as a pedestrian, a hand or a car, shows in two frames some way apart, matched by their descriptors
alone. A point of the static scene must appear on the segment between its nearest and its farthest possible depth;
matches that do not, and that one rigid motion explains, belong to a moving object. It is then followed from frame to
frame by its descriptors, without a pose, and masked out while in view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.config import Config
from torchslam.features import match_by_projection
from torchslam.geometry import SharedCamera, estimate_relative_pose, se3_inverse
from torchslam.tracking.data_association import cell_numbers, match_views
from torchslam.tracking.matcher import max_distance
from torchslam.tracking.static_overlay import StaticOverlayDetector, distances_to_views, points_at_depths
from torchslam.types import Explanation, FrameFeatures, PoseEstimate, Reason, Rejection

FRAME_INTERVAL = 5
"""Frames between two comparisons. Tried at this value only."""
MIN_ERROR = 4.0
"""Least distance of a match from every position that a static point could have, units of the keypoints' noise. Tried at
this value only."""
THRESHOLD_PX = 2.0
"""Inlier threshold of the motion that an object's matches share, pixels of reduced images. Tried at this value only."""
SEARCH_PX = 16.0
"""Search radius around the position that the object's last motion predicts, pixels of reduced images. Tried at this
value only."""
MIN_MATCHES = 20
"""Matches that must share a motion. Tried at this value only."""
MIN_OUTLIER_RATIO = 0.5
"""Ratio of the matches inconsistent with the scene that must share the motion: a majority. Tried at this value only."""
MAX_AREA_RATIO = 2.0
"""Image area of the object, relative to the area that agrees with the map, above which the pose is in doubt. Tried at
this value only."""
MAX_UNSEEN_FRAMES = 150
"""Frames for which an object is followed that is not seen to move: 5 s at 30 Hz. Tried at this value only."""
_DEPTHS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 3.0, 30.0, 1000.0)
"""Depths between which a point of the scene projects to a polyline, relative to the scene's median depth: steps that
are nearly even in the image, from what is close to the lens to infinity."""
_NUM_NEIGHBORS = 3
"""Nearest keypoints that vote on whether a keypoint belongs to the object; odd. Tried at this value only."""
_MOVING_PATIENCE = 10
"""Comparisons in which a keypoint that was seen to move may agree with the map: an object that stops stays masked for a
while. Tried at this value only."""
_NEARBY_PATIENCE = 3
"""The same for a keypoint that is only near those; shorter, since it may be of the scene. Tried at this value only."""
_MAX_DISTANCE_RATIO = 0.06
"""Largest distance from a keypoint of the object to the nearest other one, relative to the image's width: 38 px of 640.
Tried at this value only."""


@dataclass(frozen=True)
class _Observation:
    """A frame to compare later ones with: its pose, if any, in which `Submap.world`, and the median depth."""

    view: FrameFeatures
    T_cw: Float[Tensor, "4 4"] | None
    depth: float
    patience: Int[Tensor, " N"]  # comparisons for which a keypoint still belongs to the moving object
    world: tuple[int, int]


@dataclass(frozen=True)
class _Mover:
    """The moving object in the last frame: the keypoints on it, and the pixels of the others (`rest`)."""

    belongs: Bool[Tensor, " N"]
    pixels: Float[Tensor, "M 2"]
    descriptors: Shaped[Tensor, "M D"]
    scales: Float[Tensor, " M"]
    rest: Float[Tensor, "R 2"]
    motion: Float[Tensor, " 2"]  # of the object, pixels a frame

    @classmethod
    def of(cls, view: FrameFeatures, belongs: Bool[Tensor, " N"], motion: Float[Tensor, " 2"]) -> _Mover:
        rows = torch.nonzero(view.mask & belongs)[:, 0]
        rest = view.keypoints[view.mask & ~belongs]
        return cls(belongs, view.keypoints[rows], view.descriptors[rows], view.scales[rows], rest, motion)


@dataclass(frozen=True)
class Movement:
    """Independent motion in a frame: why it makes the pose uncertain, and how many keypoints are masked out, if any."""

    rejection: Rejection | None = None
    note: Explanation | None = None


NO_MOVEMENT = Movement()
"""Nothing moves, or it is not known."""


class IndependentMotion:
    """Detects one group of keypoints that moves against the scene, and follows it."""

    def __init__(self, camera: SharedCamera, config: Config) -> None:
        self.camera = camera
        self.matching = config.matching
        self.reduction = config.features.reduction(camera.current.size)
        self._mover: _Mover | None = None
        self._last: _Observation | None = None  # with the keypoints that belonged then
        self._frames_since_comparison = 0
        self._frames_since_motion = 0  # against the scene

    def mask_out(self, view: FrameFeatures) -> FrameFeatures:
        """Follow the moving object to this view, and return the view without its keypoints."""
        self._frames_since_comparison += 1
        self._frames_since_motion += 1
        if self._mover is not None:
            self._mover = self._followed(self._mover, view)
        if self._mover is not None and self._frames_since_comparison >= 2 * FRAME_INTERVAL:
            self._compare(view, None, 0.0, (0, 0))
        if self._mover is None:
            return view
        return replace(view, mask=view.mask & ~self._mover.belongs)

    def observe(
        self, view: FrameFeatures, estimate: PoseEstimate, world: tuple[int, int] = (0, 0)
    ) -> Movement:
        """Compare a posed frame, with all its keypoints, with one some frames earlier; `world`: see `Submap.world`."""
        if self._last is not None and self._last.world != world:
            self._last = replace(self._last, T_cw=None)
        mover, seen = self._mover, view.keypoints[estimate.keypoints]
        if mover is not None and self._area(mover.pixels) > MAX_AREA_RATIO * self._area(seen):
            return Movement(Rejection.of(Reason.MOVING_MAJORITY))
        if self._last is None or self._frames_since_comparison >= FRAME_INTERVAL:
            return self._compare(view, estimate.T_cw, estimate.depth, world)
        return NO_MOVEMENT

    def _followed(self, mover: _Mover, view: FrameFeatures) -> _Mover | None:
        """The object in the next frame, matched by descriptors; None if it is gone or has not moved for long."""
        matches = match_by_projection(
            mover.descriptors[None],
            (mover.pixels + mover.motion)[None],
            SEARCH_PX * self.reduction,
            view.features,
            scales=mover.scales[None],
            max_distance=max_distance(view.descriptors, self.matching),
        )
        found = matches.mask[0]
        if int(found.sum()) < MIN_MATCHES or self._frames_since_motion > MAX_UNSEEN_FRAMES:
            return None
        motion = (view.keypoints[matches.indices_2[0][found]] - mover.pixels[found]).median(0).values
        return _Mover.of(view, self._is_near_group(view.keypoints, mover.pixels + motion, mover.rest), motion)

    def _compare(
        self, view: FrameFeatures, T_cw: Tensor | None, depth: float, world: tuple[int, int]
    ) -> Movement:
        """Compare with the last observation: what moves against the scene, and what of the object moves rigidly."""
        last = self._last
        none = torch.zeros_like(view.mask, dtype=torch.int64)
        guess = none if self._mover is None else _NEARBY_PATIENCE * self._mover.belongs
        look = _Observation(view, T_cw, depth, guess, world)
        self._last, self._frames_since_comparison = look, 0
        if last is None or view.session != last.view.session:
            return NO_MOVEMENT
        frames = view.index - last.view.index
        first, second = match_views(last.view, view, self.matching)
        strays = self._errors(last, look, first, second) > MIN_ERROR
        patience = last.patience[first] - int(T_cw is not None and last.T_cw is not None)
        known = ~strays & (patience > 0)
        moving = self._rigid_group(last.view, view, first, second, strays)
        group = torch.cat([moving, self._rigid_group(last.view, view, first, second, known)])
        if len(group) == 0:
            self._mover, self._last = None, replace(look, patience=none)
            return NO_MOVEMENT
        to, fro = view.keypoints[second], last.view.keypoints[first]
        if len(moving) and self._is_pose_on_object(to, moving, strays, last.patience[first] > 0):
            return Movement(Rejection.of(Reason.MOVING_REMAINDER, count=len(moving)))
        rest = torch.ones_like(strays)
        rest[group] = False
        belongs = self._is_near_group(view.keypoints, to[group], to[rest])
        # What is near the object but agrees with the map belongs to it only while the camera has no pose.
        beside = belongs[second].to(patience.dtype)
        renewed = torch.where(strays, _MOVING_PATIENCE, patience).where(~rest, beside)
        patience = (_NEARBY_PATIENCE * belongs).index_put((second,), renewed)
        self._mover = _Mover.of(view, belongs, (to - fro)[group].median(0).values / frames)
        self._last = replace(look, patience=patience)
        if len(moving) == 0:
            return NO_MOVEMENT
        self._frames_since_motion = 0
        count = int((belongs & view.mask).sum())
        return Movement(note=Explanation.of(Reason.INDEPENDENT_MOTION, count=count))

    def _is_pose_on_object(
        self,
        pixels: Float[Tensor, "N 2"],
        group: Int[Tensor, " M"],
        strays: Bool[Tensor, " N"],
        known: Bool[Tensor, " N"],
    ) -> bool:
        """Whether the pose may follow the moving object, so that the group of moving matches is the static scene.

        So it is if what was known to move agrees with the map now (strays do not), or else if the group covers more of
        the image than what agrees.
        """
        if bool(known[group].double().mean() >= 0.5):
            return False
        if bool(known.any()):
            return 2 * int(strays[known].sum()) < int(known.sum())
        return self._area(pixels[group]) > self._area(pixels[~strays])

    def _area(self, pixels: Float[Tensor, "N 2"]) -> int:
        """Number of image cells that contain pixels."""
        return len(torch.unique(cell_numbers(pixels, self.camera.current.size)))

    def _errors(
        self, last: _Observation, look: _Observation, first: Int[Tensor, " M"], second: Int[Tensor, " M"]
    ) -> Float[Tensor, " M"]:
        """Distances of matches from where a point of the scene can be, in units of the keypoints' noise.

        Zero if a pose is unknown.
        """
        seen, view = last.view, look.view
        if last.T_cw is None or look.T_cw is None:
            return seen.keypoints.new_zeros(len(first))
        camera, T_21 = self.camera.current, look.T_cw @ se3_inverse(last.T_cw)
        points_c = points_at_depths(camera, seen.keypoints[first], last.depth, _DEPTHS)
        errors = distances_to_views(camera, T_21, points_c, view.keypoints[second])
        return errors / torch.maximum(seen.noise.gate_sigma[first], view.noise.gate_sigma[second])

    def _rigid_group(
        self,
        earlier: FrameFeatures,
        view: FrameFeatures,
        first: Int[Tensor, " M"],
        second: Int[Tensor, " M"],
        among: Bool[Tensor, " M"],
    ) -> Int[Tensor, " R"]:
        """Rows of those matches `among` that one rigid motion explains; none if these are too few."""
        rows = torch.nonzero(among)[:, 0]
        if len(rows) < MIN_MATCHES:
            return rows[:0]
        pixels = earlier.keypoints[first[rows]][None], view.keypoints[second[rows]][None]
        camera, threshold = self.camera.current, THRESHOLD_PX * self.reduction
        motion = estimate_relative_pose(
            *pixels, camera_1=camera, camera_2=camera, threshold=threshold, kernel="truncated", min_samples=64
        )
        group = rows[motion.inliers[0]]
        enough = max(MIN_MATCHES, MIN_OUTLIER_RATIO * len(rows))
        return group if len(group) >= enough else rows[:0]

    def _is_near_group(
        self, pixels: Float[Tensor, "N 2"], group: Float[Tensor, "M 2"], rest: Float[Tensor, "R 2"]
    ) -> Bool[Tensor, " N"]:
        """Which pixels belong to a group, not to the rest.

        Most of their nearest neighbors, and one within reach, are of the group.
        """
        both = torch.cat([group, rest])
        k = min(_NUM_NEIGHBORS, len(both))
        distances, nearest = torch.cdist(pixels, both).topk(k, largest=False)
        is_group = nearest < len(group)
        most = _MAX_DISTANCE_RATIO * self.camera.current.width
        reach = distances.where(is_group, torch.inf).amin(-1) < most
        return reach & (2 * is_group.sum(-1) > k)


@dataclass(frozen=True)
class FilteredView:
    """A frame without keypoints that are known not to belong to the scene, and with more of them."""

    view: FrameFeatures  # without overlays and moving objects
    without_overlays: FrameFeatures  # without static overlays only
    whole: FrameFeatures  # with all keypoints


class SceneFilter:
    """Masks out keypoints of static overlays and moving objects."""

    def __init__(self, camera: SharedCamera, config: Config) -> None:
        self.static_overlay = StaticOverlayDetector(camera, config)
        self.independent_motion = IndependentMotion(camera, config)

    def mask_out(self, view: FrameFeatures) -> FilteredView:
        """Mask out what is known not to belong to the scene; moving objects are followed from frame to frame."""
        without_overlays = self.static_overlay.mask_out(view)
        return FilteredView(self.independent_motion.mask_out(without_overlays), without_overlays, view)

    def detect_independent_motion(
        self, filtered: FilteredView, estimate: PoseEstimate, world: tuple[int, int]
    ) -> Movement:
        """Detect keypoints that move against the scene, given the frame's pose and its `Submap.world`."""
        return self.independent_motion.observe(filtered.without_overlays, estimate, world)

    def update_overlay(
        self, filtered: FilteredView, T_cw: Float[Tensor, "4 4"], depth: float, world: tuple[int, int]
    ) -> bool:
        """Update the overlays with a frame, its pose and its `Submap.world`; return whether there are new ones."""
        return self.static_overlay.observe(filtered.whole, T_cw, depth, world) > 0
