"""Pose the frames between the keyframes of a finished map by tracking from keyframe to keyframe."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import SensorModel, SharedCamera, transform
from torchslam.map.atlas import Submap
from torchslam.map.map import Map
from torchslam.tracking.data_association import match_keyframe
from torchslam.tracking.pose_validation import check_pose
from torchslam.tracking.tracker import Tracker, single_frame_state
from torchslam.types import Explanation, FrameFeatures, PoseEstimate, Reason, State, StepResult

NUM_NEAREST = 3  # keyframes in time for the relocalization of a lost frame


@torch.no_grad()
def pose_frames(
    submap: Submap,
    views: Iterable[FrameFeatures],
    sensor: SensorModel,
    config: Config,
    given_cw: dict[int, Float[Tensor, "4 4"]] | None = None,
) -> list[StepResult]:
    """Add all views to the posed frames of a submap, whose map has some of them as keyframes, in order.

    Args:
        submap: receives the frames.
        views: in the order of time; each is needed once.
        sensor: of all views.
        config: of the tracker.
        given_cw: poses of the views by another program, by frame: these are the online poses then.
    """
    tracker = Tracker(SharedCamera(sensor.camera, sensor.readout), config)
    row_of = {index: row for row, index in enumerate(submap.map.keyframes["frame_index"].tolist())}
    tracker.reset_to_keyframe(submap, 0)
    results = []
    for view in views:
        if view.index in row_of:
            result = _add_keyframe(tracker, submap, view, row_of[view.index])
        else:
            result = _track(tracker, submap, view)
        if given_cw is not None:
            result = replace(result, T_cw=given_cw[view.index], submap=submap.number)
        results.append(result)
    return results


def _add_keyframe(tracker: Tracker, submap: Submap, view: FrameFeatures, keyframe: int) -> StepResult:
    """Add a keyframe with its pose of the map."""
    tracker.reset_to_keyframe(submap, keyframe)
    submap.tracking.velocity = None
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


def _track(tracker: Tracker, submap: Submap, view: FrameFeatures) -> StepResult:
    """Track a frame from the last keyframe, or relocalize it by the keyframes nearest in time."""
    view = tracker.at_middle_row(submap, view)
    estimate = tracker.track(submap, view)
    tracker.commit(submap, view, estimate)
    if estimate is None:
        slam_map = submap.map
        away = (slam_map.keyframes["frame_index"] - view.index).abs()
        nearest = torch.argsort(away, stable=True)[:NUM_NEAREST]
        candidates = (match_keyframe(slam_map, row, view, tracker.matcher) for row in nearest.tolist())
        points = slam_map.observed_points(nearest)
        estimate = tracker.localizer.locate(slam_map, view, candidates, points)
        if estimate is None:
            reasons = (Explanation(Reason.NOT_FOUND),)
            return StepResult(view.index, view.timestamp, State.LOST, None, reasons=reasons)
        tracker.start_at_estimate(submap, view, estimate)
    rejection = check_pose(estimate, None, single_frame_state(submap.tracking, estimate)).rejection
    submap.posed_frames.add(view, estimate, submap.tracking.T_cr, submap.tracking.reference)
    return StepResult(
        view.index,
        view.timestamp,
        State.UNCERTAIN if rejection else State.TRACKING,
        estimate.T_cw.clone(),
        submap.number,
        covariance=estimate.covariance,
        matches=estimate.matches,
        inliers=estimate.inliers,
        reasons=(rejection,) if rejection else (),
    )


def _keyframe_estimate(slam_map: Map, keyframe: int) -> PoseEstimate:
    """The pose estimate of a keyframe with its own observations."""
    table = slam_map.keyframes["point_ids"][keyframe]
    keypoints = torch.nonzero(table >= 0)[:, 0]
    seen, T_cw = table[keypoints], slam_map.T_cw[keyframe]
    depth = float(transform(T_cw, slam_map.positions_w[seen])[:, 2].median()) if len(seen) else 0.0
    return PoseEstimate(T_cw, seen, keypoints, len(seen), slam_map.keyframes["covariances"][keyframe], depth)
