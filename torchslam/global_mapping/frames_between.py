"""Pose the frames between the keyframes of a finished map by tracking from keyframe to keyframe.

The keypoints of a keyframe that have a point are followed through the images after it by optical flow, which takes a
tenth of the time of new features. Where too few can be followed, or the pose is doubtful, features are extracted.
Source of the flow: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import SensorModel, SharedCamera, transform
from torchslam.map.atlas import Submap
from torchslam.map.map import Map
from torchslam.tracking.data_association import match_keyframe
from torchslam.tracking.pose_validation import Rejection, check_pose
from torchslam.tracking.tracker import Tracker, single_frame_state
from torchslam.types import Explanation, Frame, FrameFeatures, PoseEstimate, Reason, State, StepResult

NUM_NEAREST = 3  # keyframes in time for the relocalization of a lost frame
WINDOW_PX, LEVELS = 21, 3
"""Side of the window that is followed, in pixels of the images in which features are found, and levels of the pyramid
above the first: OpenCV's defaults."""
MOST_APART_PX = 1.0
"""Distance up to which a keypoint that is followed to an image and back arrives where it began. Tried at this value
only."""
MOST_FOLLOWED = 30
"""Images through which keypoints are followed from a keyframe: further on few are left. Tried at this value only."""
MOST_KEYPOINTS = 400
"""Keypoints that are followed from a keyframe. All of them, 36 observations of a point on redkitchen, give the same
errors, in 1.08 times the CPU time and 1.2 times the memory of a whole run; with 250 it takes as long. Tried 250, 400
and all, on redkitchen and machine_hall."""
CELL_PX = 40.0
"""Side of the cells over which these are spread, in pixels of the images in which features are found. Tried at this
value only."""

Gray = UInt8[np.ndarray, "H W"]
"""An image in the size in which features are found."""


@dataclass(frozen=True)
class Still:
    """A frame between keyframes."""

    index: int
    timestamp: float
    gray: Gray


@dataclass(frozen=True)
class Template:
    """The keypoints of a keyframe that have a point, and its image, which is `reduction` times as large.

    They are followed by optical flow from the keyframe itself to each image, so that nothing drifts.
    """

    view: FrameFeatures
    gray: Gray
    reduction: float

    @classmethod
    def of(cls, view: FrameFeatures, gray: Gray, kept: Bool[Tensor, " N"], reduction: float) -> Template:
        """Of a keyframe; `kept`: the keypoints with a point, in order of falling strength."""
        rows = kept.nonzero()[:, 0]
        rows = rows[spread(view.detected[rows] / reduction, MOST_KEYPOINTS)]
        columns = "keypoints", "scales", "angles", "descriptors", "mask", "information", "detected"
        return cls(replace(view, **{name: getattr(view, name)[rows] for name in columns}), gray, reduction)

    def follow(self, images: Iterable[Still]) -> Iterator[FrameFeatures]:
        """The keypoints in each of some images, one next to the other, masked where they could not be followed."""
        begin = self.view.detected.cpu().numpy().astype(np.float32) / self.reduction
        follow = partial(
            cv2.calcOpticalFlowPyrLK,
            winSize=(WINDOW_PX, WINDOW_PX),
            maxLevel=LEVELS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        last = begin
        for image in images:
            found, forth, _ = follow(self.gray, image.gray, begin, last.copy())
            back, home, _ = follow(image.gray, self.gray, found, begin.copy())
            is_followed = (forth[:, 0] == 1) & (home[:, 0] == 1)
            is_followed &= np.linalg.norm(back - begin, axis=-1) < MOST_APART_PX
            last = np.where(is_followed[:, None], found, last)
            pixels = torch.from_numpy(self.reduction * found.astype(np.float64)).to(self.view.keypoints)
            mask = torch.from_numpy(is_followed).to(self.view.mask.device)
            yield replace(
                self.view,
                index=image.index,
                timestamp=image.timestamp,
                keypoints=pixels,
                detected=pixels,
                mask=mask,
            )


def spread(pixels: Float[Tensor, "N 2"], most: int) -> Int[Tensor, " M"]:
    """The rows, ascending, of at most so many pixels: the first of each cell, then the second of each, and so on."""
    x, y = (pixels / CELL_PX).floor().long().unbind(-1)
    cell, order = (x * (1 << 20) + y).sort(stable=True)
    first = torch.searchsorted(cell, cell)
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order), device=order.device) - first
    return place.argsort(stable=True)[:most].sort().values


def gray_of(image: Float[Tensor, "1 1 H W"], reduction: float) -> Gray:
    """An image in the size in which features are found."""
    gray = (255 * image[0, 0]).round().to(torch.uint8).cpu().numpy()
    if reduction == 1.0:
        return gray
    size = round(gray.shape[1] / reduction), round(gray.shape[0] / reduction)
    return cv2.resize(gray, size, interpolation=cv2.INTER_AREA)


class FollowedViews:
    """The views of frames: of those that were mapped, and between them the keypoints of the nearer keyframe.

    Args:
        read: a frame by its index; None if it cannot be read.
        extract: the features of a frame that is too far from keyframes; None as of `read`.
        mapped: the views of frames that were mapped, by index.
        with_point: the keypoints of keyframes that have a point, by index.
        reduction: factor by which images are reduced before keypoints are found.
    """

    def __init__(
        self,
        read: Callable[[int], Frame | None],
        extract: Callable[[int], FrameFeatures | None],
        mapped: Mapping[int, FrameFeatures],
        with_point: Mapping[int, Bool[Tensor, " N"]],
        reduction: float,
    ) -> None:
        self.read, self.extract, self.reduction = read, extract, reduction
        self.mapped, self.with_point = mapped, with_point
        self._followed = set[int]()

    def again(self, index: int) -> FrameFeatures | None:
        """The features of a frame whose view was of followed keypoints; None for another one."""
        return self.extract(index) if index in self._followed else None

    def of(self, frames: Iterable[int]) -> Iterator[FrameFeatures | None]:
        """The views of frames, in order; None for one that cannot be read."""
        before: Template | None = None
        between, last = list[int](), -1
        for index in frames:
            if index not in self.mapped:
                between.append(index)
                continue
            after = self._template(index) if between else None
            yield from self._between(before or self._template(last) if between else None, between, after)
            yield self.mapped[index]
            before, between, last = after, [], index
        yield from self._between(before or self._template(last) if between else None, between, None)

    def _between(
        self, before: Template | None, frames: list[int], after: Template | None
    ) -> Iterator[FrameFeatures | None]:
        """The views of frames between two keyframes, either of which may be missing."""
        middle = len(frames) // 2 if before and after else len(frames) if before else 0
        forth, back = frames[:middle][:MOST_FOLLOWED], frames[middle:][-MOST_FOLLOWED:] if after else []
        if before is not None:
            yield from before.follow(self._stills(forth))
        for index in frames[len(forth) : len(frames) - len(back)]:
            yield self.extract(index)
        if after is not None:
            yield from reversed(list(after.follow(self._stills(reversed(back)))))

    def _stills(self, frames: Iterable[int]) -> Iterator[Still]:
        for index in frames:
            frame = self.read(index)
            if frame is not None:
                self._followed.add(index)
                yield Still(index, frame.timestamp, gray_of(frame.image, self.reduction))

    def _template(self, index: int) -> Template | None:
        """Of a frame that was mapped; None if it is no keyframe."""
        frame = self.read(index) if index in self.with_point else None
        if frame is None:
            return None
        gray = gray_of(frame.image, self.reduction)
        return Template.of(self.mapped[index], gray, self.with_point[index], self.reduction)


@torch.no_grad()
def pose_frames(
    submap: Submap,
    views: Iterable[FrameFeatures],
    sensor: SensorModel,
    config: Config,
    given_cw: dict[int, Float[Tensor, "4 4"]] | None = None,
    again: Callable[[int], FrameFeatures | None] | None = None,
) -> list[StepResult]:
    """Add all views to the posed frames of a submap, whose map has some of them as keyframes, in order.

    Args:
        submap: receives the frames.
        views: in the order of time; each is needed once.
        sensor: of all views.
        config: of the tracker.
        given_cw: poses of the views by another program, by frame: these are the online poses then.
        again: the features of a frame whose view is of followed keypoints, or None; None: there is no such frame.
    """
    tracker = Tracker(SharedCamera(sensor.camera, sensor.readout), config)
    row_of = {index: row for row, index in enumerate(submap.map.keyframes["frame_index"].tolist())}
    tracker.reset_to_keyframe(submap, 0)
    results = []
    for view in views:
        if view.index in row_of:
            result = _add_keyframe(tracker, submap, view, row_of[view.index])
        else:
            result = _track(tracker, submap, view, again)
        if given_cw is not None:
            result = replace(result, T_cw=given_cw[view.index], submap=submap.number)
        results.append(result)
    return results


def _add_keyframe(tracker: Tracker, submap: Submap, view: FrameFeatures, keyframe: int) -> StepResult:
    """Add a keyframe with its pose of the map."""
    tracker.reset_to_keyframe(submap, keyframe)
    submap.tracking = submap.tracking.without_motion()
    own = _keyframe_estimate(submap.map, keyframe)
    submap.posed_frames.add(view, own, submap.tracking.T_cr, keyframe)
    return StepResult(
        view.index,
        view.timestamp,
        State.TRACKING,
        own.T_cw.clone(),
        submap.number,
        is_keyframe=True,
        matches=own.matches,
        inliers=own.inliers,
    )


def _track(
    tracker: Tracker,
    submap: Submap,
    view: FrameFeatures,
    again: Callable[[int], FrameFeatures | None] | None,
) -> StepResult:
    """Track a frame from the last keyframe, or relocalize it by the keyframes nearest in time.

    What was followed, the frame's own features, and its relocalization are tried in this order until a pose is not
    doubtful; else the pose with most inliers is taken.
    """
    best: tuple[FrameFeatures, PoseEstimate, bool] | None = None
    doubt: Rejection | None = None
    for found in _estimates(tracker, submap, view, again):
        reason = _doubt(submap, found[1])
        if best is None or reason is None or found[1].inliers > best[1].inliers:
            best, doubt = found, reason
        if reason is None:
            break
    if best is None:
        tracker.commit(submap, view, None)
        reasons = (Explanation(Reason.NOT_FOUND),)
        return StepResult(view.index, view.timestamp, State.LOST, None, reasons=reasons)
    view, estimate, is_tracked = best
    tracker.commit(submap, view, estimate if is_tracked else None)
    if not is_tracked:
        tracker.start_at_estimate(submap, view, estimate)
    submap.posed_frames.add(view, estimate, submap.tracking.T_cr, submap.tracking.reference)
    return StepResult(
        view.index,
        view.timestamp,
        State.UNCERTAIN if doubt else State.TRACKING,
        estimate.T_cw.clone(),
        submap.number,
        covariance=estimate.covariance,
        matches=estimate.matches,
        inliers=estimate.inliers,
        reasons=(doubt,) if doubt else (),
    )


def _estimates(
    tracker: Tracker,
    submap: Submap,
    view: FrameFeatures,
    again: Callable[[int], FrameFeatures | None] | None,
) -> Iterator[tuple[FrameFeatures, PoseEstimate, bool]]:
    """Poses of a frame, each with the view that it is of, and whether it was tracked."""
    own = tracker.at_middle_row(submap, view)
    estimate = tracker.track(submap, own)
    if estimate is not None:
        yield own, estimate, True
    extracted = None if again is None else again(view.index)
    if extracted is not None:
        own = tracker.at_middle_row(submap, extracted)
        estimate = tracker.track(submap, own)
        if estimate is not None:
            yield own, estimate, True
    slam_map = submap.map
    away = (slam_map.keyframes["frame_index"] - view.index).abs()
    nearest = torch.argsort(away, stable=True)[:NUM_NEAREST]
    candidates = (match_keyframe(slam_map, row, own, tracker.matcher) for row in nearest.tolist())
    estimate = tracker.localizer.locate(slam_map, own, candidates, slam_map.observed_points(nearest))
    if estimate is not None:
        yield own, estimate, False


def _doubt(submap: Submap, estimate: PoseEstimate) -> Rejection | None:
    """Why the pose of a frame is doubtful by itself; None if it is not."""
    return check_pose(estimate, None, single_frame_state(submap.tracking, estimate)).rejection


def _keyframe_estimate(slam_map: Map, keyframe: int) -> PoseEstimate:
    """The pose estimate of a keyframe with its own observations."""
    table = slam_map.keyframes["point_ids"][keyframe]
    keypoints = torch.nonzero(table >= 0)[:, 0]
    seen, T_cw = table[keypoints], slam_map.T_cw[keyframe]
    depth = float(transform(T_cw, slam_map.positions_w[seen])[:, 2].median()) if len(seen) else 0.0
    return PoseEstimate(T_cw, seen, keypoints, len(seen), slam_map.keyframes["covariances"][keyframe], depth)
