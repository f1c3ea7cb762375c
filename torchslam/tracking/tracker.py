"""Where is the camera now? Predict, match the local map, localize, and go on from there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    Camera,
    se3_inverse,
)
from torchslam.geometry.motion import reorthonormalized
from torchslam.map.map import Map
from torchslam.map.submap import Submap
from torchslam.map.tracking_state import TrackingState
from torchslam.tracking.correspondences import match_near, match_points
from torchslam.tracking.localizer import Localizer
from torchslam.tracking.matcher import Matcher, MatchIndices, make_matcher
from torchslam.types import FrameFeatures, PoseEstimate

MEMORY = 0.1  # share of the newest frame in what the track remembers: that of the last ten or so


class Tracker:
    """Follows the camera against the local map: the keyframes around the reference keyframe and their points.

    It keeps nothing itself: where the camera was is the track of the world.

    counts: whether points remember when and how often they were seen; without it, tracking leaves the map as it is
    """

    counts = True

    def __init__(self, camera: Camera, config: Config, matcher: Matcher | None = None) -> None:
        self.localizer = Localizer(camera, config)
        self.matcher = make_matcher(config.matching, matcher)
        self.settings = config.tracking
        self.matching = config.matching

    # --- the track -------------------------------------------------------------------------------------------

    def follow(self, world: Submap, keyframe: int) -> None:
        """Go on from a keyframe: the last frame is at its place."""
        T_cw = world.map.T_cw[keyframe]
        seen = world.map.keyframes["point_ids"][keyframe]
        world.track = replace(
            self._around(world.map, keyframe, T_cw),
            velocity=world.track.velocity,
            seen_last=seen[seen >= 0],
            error=world.track.error,
            explained=world.track.explained,
        )

    def _around(self, slam_map: Map, keyframe: int, T_cw: Tensor) -> TrackingState:
        """A track that is at T_cw, seen from this keyframe; what is around the keyframe is the local map."""
        near = slam_map.covisible(keyframe, self.settings.local_keyframes)
        local_keyframes = torch.cat([near.new_tensor([keyframe]), near])
        recent = self.settings.recent_frames if self.counts else 0
        if recent:
            last_seen = slam_map.points["last_seen_frame"]
            local_points = torch.nonzero(
                (last_seen > last_seen.max() - recent) & slam_map.points["is_valid"]
            )[:, 0]
        else:
            local_points = slam_map.points_seen_by(local_keyframes)
        return TrackingState(
            T_cr=T_cw @ se3_inverse(slam_map.T_cw[keyframe]),
            reference=keyframe,
            reference_size=well_observed(slam_map, keyframe, local_keyframes),
            velocity=None,
            seen_last=local_points[:0],
            local_keyframes=local_keyframes,
            local_points=local_points,
        )

    def predict(self, world: Submap) -> Tensor:
        """(4, 4) where the next frame should be: constant velocity."""
        if world.track.velocity is None or not self.settings.motion_model:
            return world.T_cw
        return reorthonormalized(world.track.velocity @ world.T_cw)

    # --- one frame -------------------------------------------------------------------------------------------

    def track(self, world: Submap, view: FrameFeatures, is_sure: bool = True) -> PoseEstimate | None:
        """Locate the frame that comes after the last one; None when it cannot be located.

        is_sure: the last frames are believed, so that the pose is looked for next to where they lead
        """
        expected = self.predict(world)
        candidates = self._candidates(world, view, expected)
        tracked = self.localizer.locate(
            world.map, view, candidates, world.track.local_points, expected if is_sure else None
        )
        if tracked is None:
            world.track.velocity = None
            return None
        self.accept(world, view, tracked)
        return tracked

    def _candidates(self, world: Submap, view: FrameFeatures, T_cw: Tensor) -> Iterator[MatchIndices]:
        """Ever wider guesses of who matches whom: near the prediction, in a wider window, anywhere."""
        slam_map, track, settings = world.map, world.track, self.settings
        if settings.guided_matching:
            alive = track.seen_last[slam_map.points["is_valid"][track.seen_last]]
            near = self.localizer.project(slam_map, alive, T_cw, view)
            yield match_near(slam_map, near, view, settings.search_radius_px, self.matcher, ratio=0.9)
            local = self.localizer.project(slam_map, track.local_points, T_cw, view)
            wide = settings.search_radius_px * settings.wide_radius_factor
            yield match_near(slam_map, local, view, wide, self.matcher, ratio=0.9)
        else:
            local = self.localizer.project(slam_map, track.local_points, T_cw, view)
        yield match_points(slam_map, local.ids, view, self.matching)
        yield match_points(slam_map, track.local_points, view, self.matching)

    def accept(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate) -> None:
        """Take a frame over into the track: velocity, reference keyframe, counters of the points."""
        slam_map, track = world.map, world.track
        track.velocity = tracked.T_cw @ se3_inverse(world.T_cw)
        track.seen_last = tracked.point_ids
        track.error += MEMORY * (tracked.error - track.error)
        track.explained += MEMORY * (tracked.explained - track.explained)
        self._count(slam_map, view, tracked)
        shared = slam_map.observers(tracked.point_ids, track.local_keyframes)
        best = int(track.local_keyframes[shared.argmax()])
        if best == track.reference:
            track.T_cr = tracked.T_cw @ se3_inverse(slam_map.T_cw[best])
        else:
            world.track = replace(
                self._around(slam_map, best, tracked.T_cw),
                velocity=track.velocity,
                seen_last=track.seen_last,
                error=track.error,
                explained=track.explained,
            )

    def start_at(self, world: Submap, view: FrameFeatures, tracked: PoseEstimate) -> None:
        """Begin a track anew, wherever in the map: at a frame that was located without one."""
        best = int(world.map.observers(tracked.point_ids).argmax())
        self._count(world.map, view, tracked)
        world.track = replace(
            self._around(world.map, best, tracked.T_cw), velocity=None, seen_last=tracked.point_ids
        )

    def expect(self, slam_map: Map, tracked: PoseEstimate) -> None:
        """A frame is believed: the points that it should see were there to be seen."""
        if self.counts:
            expected = tracked.point_ids if tracked.expected is None else tracked.expected
            slam_map.points["times_visible"][expected] += 1

    def vouch(self, slam_map: Map, tracked: PoseEstimate) -> None:
        """A frame is believed: it speaks for the points that it saw."""
        if self.counts:
            slam_map.points["times_found"][tracked.point_ids] += 1

    def _count(self, slam_map: Map, view: FrameFeatures, tracked: PoseEstimate) -> None:
        """The points that a frame saw remember when that was."""
        if self.counts:
            slam_map.points["last_seen_frame"][tracked.point_ids] = view.index


def well_observed(slam_map: Map, keyframe: int, local_keyframes: Tensor) -> int:
    """How many points of a keyframe three local keyframes see: what the next frames can be expected to see."""
    table = slam_map.keyframes["point_ids"]
    local = table[local_keyframes].flatten()
    counts = torch.bincount(local[local >= 0], minlength=len(slam_map.points))
    seen = table[keyframe]
    return int((counts[seen[seen >= 0]] >= min(3, len(local_keyframes))).sum())
