"""Pose the frames between the keyframes of a finished map by tracking from keyframe to keyframe."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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
from torchslam.types import Explanation, FrameFeatures, MatchIndices, PoseEstimate, Reason, State, StepResult

NUM_NEAREST = 3  # keyframes in time for the relocalization of a lost frame


class FramePoser:
    """Poses the views of a sequence in a map whose keyframes are some of them."""

    def __init__(self, sensor: SensorModel, config: Config) -> None:
        """Create a tracker.

        Args:
            sensor: Of all views.
            config: Of the tracker.
        """
        self.tracker = Tracker(SharedCamera(sensor.camera, sensor.readout), config)

    @torch.no_grad()
    def pose(
        self,
        submap: Submap,
        views: Iterable[FrameFeatures],
        given_cw: dict[int, Float[Tensor, "4 4"]] | None = None,
    ) -> list[StepResult]:
        """Add all views to the posed frames of the submap, in order.

        Args:
            submap: Whose map has some of the views as keyframes.
            views: In the order of time; each is needed once.
            given_cw: Poses of the views by another program, by frame.

        Returns:
            One result per view, with its given pose as online pose, or else with its own.
        """
        row_of = {index: row for row, index in enumerate(submap.map.keyframes["frame_index"].tolist())}
        self.tracker.reset_to_keyframe(submap, 0)
        results = []
        for view in views:
            keyframe = row_of.get(view.index)
            if keyframe is not None:
                result = self._add_keyframe(submap, view, keyframe)
            else:
                result = self._track(submap, view)
            if given_cw is not None:
                result = replace(result, T_cw=given_cw[view.index], submap=submap.number)
            results.append(result)
        return results

    def _add_keyframe(self, submap: Submap, view: FrameFeatures, keyframe: int) -> StepResult:
        """Add a keyframe with its pose of the map."""
        slam_map = submap.map
        self.tracker.reset_to_keyframe(submap, keyframe)
        submap.tracking.velocity = None
        own = keyframe_estimate(slam_map, keyframe)
        submap.posed_frames.add(view, own, submap.tracking.T_cr, keyframe)
        return StepResult(
            view.index,
            view.timestamp,
            State.TRACKING,
            slam_map.T_cw[keyframe].clone(),
            submap.number,
            is_keyframe=True,
            matches=own.matches,
            inliers=own.inliers,
        )

    def _track(self, submap: Submap, view: FrameFeatures) -> StepResult:
        """Track a frame from the last keyframe, or relocalize it by the keyframes nearest in time."""
        view = self.tracker.at_middle_row(submap, view)
        estimate = self.tracker.track(submap, view)
        self.tracker.commit(submap, view, estimate)
        if estimate is None:
            estimate = self._find(submap, view)
        if estimate is None:
            return StepResult(
                view.index, view.timestamp, State.LOST, None, reasons=(Explanation(Reason.NOT_FOUND),)
            )
        state = single_frame_state(submap.tracking, estimate)
        rejection = check_pose(estimate, None, state).rejection
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

    def _find(self, submap: Submap, view: FrameFeatures) -> PoseEstimate | None:
        slam_map = submap.map
        away = (slam_map.keyframes["frame_index"] - view.index).abs()
        nearest = torch.argsort(away, stable=True)[:NUM_NEAREST]
        estimate = self.tracker.localizer.locate(
            slam_map, view, self._candidates(slam_map, view, nearest), slam_map.observed_points(nearest)
        )
        if estimate is not None:
            self.tracker.start_at_estimate(submap, view, estimate)
        return estimate

    def _candidates(self, slam_map: Map, view: FrameFeatures, nearest: Tensor) -> Iterator[MatchIndices]:
        for keyframe in nearest.tolist():
            yield match_keyframe(slam_map, keyframe, view, self.tracker.matcher)


def keyframe_estimate(slam_map: Map, keyframe: int) -> PoseEstimate:
    """Return the pose estimate of a keyframe with its own observations."""
    table = slam_map.keyframes["point_ids"][keyframe]
    keypoints = torch.nonzero(table >= 0)[:, 0]
    seen, T_cw = table[keypoints], slam_map.T_cw[keyframe]
    depth = float(transform(T_cw, slam_map.positions_w[seen])[:, 2].median()) if len(seen) else 0.0
    return PoseEstimate(T_cw, seen, keypoints, len(seen), slam_map.keyframes["covariances"][keyframe], depth)
