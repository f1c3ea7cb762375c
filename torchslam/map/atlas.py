"""The atlas: the submaps of a run, each with its map, its posed frames and its tracking state.

A run starts a new submap when the camera is lost for long, and merges submaps when loop closing recognizes a shared
place. Term: Campos et al., "ORB-SLAM3: an accurate open-source library for visual, visual-inertial and multi-map
SLAM", 2021.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry import Camera, SensorModel, sim3_inverse, sim3_scale
from torchslam.geometry.transforms import carry_points, covariances_with_unit, with_unit, without_scale
from torchslam.geometry.zoom import Zoom
from torchslam.map.map import Map
from torchslam.map.posed_frames import PosedFrames
from torchslam.map.unit import MetricUnit
from torchslam.types import PoseEstimate, Trajectory

EMA_RATE = 0.1
"""Weight of the newest frame in the moving averages of the tracking state: about the last ten frames count. Tried at
this value only."""

MAX_MOTIONS = 10
"""Motions that are kept for a motion model: a third of a second of video. Tried at this value only."""


@dataclass
class TrackingState:
    """The state of tracking in a submap after the last frame.

    Attributes:
        T_cr: Pose of the last frame relative to its reference keyframe, so that it follows the map.
        reference: Row of the reference keyframe; -1 before there is one.
        reference_size: Number of points of the reference keyframe that other keyframes observe as well.
        motions: The last motions, T_c_previous, the newest at the end, at most `MAX_MOTIONS`; none if unknown.
        last_inlier_points: Points that the last frame observed.
        local_keyframes: Keyframes of the local map: the reference keyframe and the most covisible ones.
        local_points: Points of the local map: those that the local keyframes observe.
        error: Moving average of the median squared error of the matches in units of their variance.
        explained_ratio: Moving average of the ratio of image cells with keypoints in which some agree with the map.
        timestamp: Of the last frame, seconds; None if unknown.
        intervals: Seconds that each motion takes, negative backward in time; 0 if unknown.
    """

    T_cr: Float[Tensor, "4 4"]
    reference: int
    reference_size: int
    motions: Float[Tensor, "M 4 4"]
    intervals: Float[Tensor, " M"]
    last_inlier_points: Int[Tensor, " N"]
    local_keyframes: Int[Tensor, " K"]
    local_points: Int[Tensor, " L"]
    error: float = 0.0
    explained_ratio: float = 1.0
    timestamp: float | None = None

    @classmethod
    def empty(cls, like: Float[Tensor, "..."]) -> TrackingState:
        """Create the state before the first keyframe, with the device and floating-point type of `like`."""
        none = torch.empty(0, dtype=torch.int64, device=like.device)
        eye = torch.eye(4, dtype=like.dtype, device=like.device)
        return cls(eye, -1, 0, eye.new_empty(0, 4, 4), eye.new_empty(0), none, none, none)

    def moved(self, motion: Float[Tensor, "4 4"], timestamp: float) -> TrackingState:
        """The same state after a motion to a frame at a time."""
        interval = self.intervals.new_tensor([self.seconds_to(timestamp)])
        return replace(
            self,
            motions=torch.cat((self.motions, motion[None]))[-MAX_MOTIONS:],
            intervals=torch.cat((self.intervals, interval))[-MAX_MOTIONS:],
            timestamp=timestamp,
        )

    def without_motion(self) -> TrackingState:
        """The same state after a frame without a pose."""
        return replace(self, motions=self.motions[:0], intervals=self.intervals[:0])

    def seconds_to(self, timestamp: float) -> float:
        """Seconds from the last frame to one at a time; 0 if unknown."""
        return 0.0 if self.timestamp is None else timestamp - self.timestamp

    def renumbered(self, keyframes: Int[Tensor, " K"], points: Int[Tensor, " L"]) -> TrackingState:
        """The same state with new rows of keyframes and points, -1 where they were removed."""
        local, seen, last = (
            keyframes[self.local_keyframes],
            points[self.local_points],
            self.last_inlier_points,
        )
        return replace(
            self,
            reference=int(keyframes[self.reference]) if self.reference >= 0 else -1,
            last_inlier_points=points[last][points[last] >= 0],
            local_keyframes=local[local >= 0],
            local_points=seen[seen >= 0],
        )

    def averaged_with(self, estimate: PoseEstimate) -> TrackingState:
        """The same state with the averages over the frames up to that of an estimate."""
        error = self.error + EMA_RATE * (estimate.error - self.error)
        explained = self.explained_ratio + EMA_RATE * (estimate.explained_ratio - self.explained_ratio)
        return replace(self, error=error, explained_ratio=explained)


@dataclass
class Submap:
    """A map with a coordinate frame of its own, the frames posed in it, and the tracking state.

    Attributes:
        number: From 0, in the order in which the submaps of a run were created.
        tracking: The state of tracking after the last frame.
        map: Keyframes and points.
        posed_frames: All frames with a pose in the map.
        num_cull_checked: Number of leading keyframes that keyframe culling has already checked.
        epoch: Changes when poses from before it cannot be compared with those after it: the keyframes were corrected as
            a whole, or tracking started anew.
        metric: How well the unit is known to be a meter; None where it is arbitrary.
    """

    number: int
    tracking: TrackingState
    map: Map = field(default_factory=Map)
    posed_frames: PosedFrames = field(default_factory=PosedFrames)
    num_cull_checked: int = 0
    epoch: int = 0
    metric: MetricUnit | None = None

    @classmethod
    def empty(cls, number: int, like: Float[Tensor, "..."]) -> Submap:
        """Create an empty submap with the device and floating-point type of `like`."""
        return cls(number, TrackingState.empty(like))

    @property
    def world(self) -> tuple[int, int]:
        """What poses have to share to be compared with each other: the submap and its epoch."""
        return self.number, self.epoch

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """The current pose of the last frame."""
        return self.tracking.T_cr @ self.map.T_cw[self.tracking.reference]

    def trajectory(self, session: int | None = None) -> Trajectory:
        """Return the current poses of all posed frames, or of those of one session."""
        return self.posed_frames.trajectory(self.map, session)

    def fork(self) -> Submap:
        """Return a submap that shares map and posed frames but has a tracking state of its own."""
        return replace(self, tracking=replace(self.tracking))

    def correct_keyframes(self, sensor: SensorModel, newest: int | None = None) -> None:
        """Set the keypoints of keyframes to those of a global shutter; `newest`: how many of them, None: all."""
        rows = None if newest is None else torch.argsort(self.map.keys, descending=True)[:newest]
        self.posed_frames.correct_keyframes(self.map, sensor, rows)

    def undo_zoom(self, zoom: Zoom, camera: Camera) -> None:
        """Undo a zoom in the keypoints of all frames, which are of one session."""
        self.posed_frames.undo_zoom(self.map, zoom, camera)

    def apply_sim3_correction(self, S_cw: Float[Tensor, "K 4 4"]) -> None:
        """Move every keyframe to the pose of its Sim(3) S_cw, world to camera.

        The scale of S_cw changes the map unit around the keyframe. Points follow the keyframe that created them, posed
        frames and the tracking state their reference keyframe.
        """
        self.epoch += 1
        points, first_keyframe, scale = self.map.points, self.map.points["first_keyframe"], sim3_scale(S_cw)
        points["positions_w"][:], points["covariances_w"][:], points["view_directions_w"][:] = carry_points(
            points["positions_w"],
            points["covariances_w"],
            points["view_directions_w"],
            self.map.T_cw[first_keyframe],
            S_cw[first_keyframe],
        )
        points["scale_distance"][:] /= scale[first_keyframe]
        covariances = self.map.keyframes["covariances"]
        covariances[:] = covariances_with_unit(covariances, scale)
        self.map.keyframes["T_cw"][:] = without_scale(S_cw)
        self.posed_frames.rescale(1 / scale)
        if self.tracking.reference >= 0:
            around = scale[self.tracking.reference]
            self.tracking.T_cr = with_unit(self.tracking.T_cr, around)
            self.tracking.motions = with_unit(self.tracking.motions, around)

    def transform(self, S_ba: Float[Tensor, "4 4"]) -> None:
        """Change the coordinate frame and unit by a Sim(3): points p become S_ba p."""
        self.apply_sim3_correction(self.map.T_cw @ sim3_inverse(S_ba))

    def merge(self, other: Submap, S_ab: Float[Tensor, "4 4"]) -> None:
        """Move everything of another submap into this one by a Sim(3) S_ab; the other is empty afterwards.

        The other's rows of keyframes, points and frames are appended. The tracking state becomes that of the other. If
        the other alone is in meters, the whole is in its world.
        """
        if self.metric is None and other.metric is not None:
            self.transform(sim3_inverse(S_ab))
            self.metric = other.metric
        else:
            other.transform(S_ab)
        keyframes, points = self.map.append(other.map)
        self.posed_frames.append(other.posed_frames, keyframes, points)
        device = self.map.T_cw.device
        keyframe_rows = torch.arange(keyframes, len(self.map.keyframes), device=device)
        point_rows = torch.arange(points, len(self.map.points), device=device)
        self.tracking = other.tracking.renumbered(keyframe_rows, point_rows)
        self.epoch += 1
        other.map, other.posed_frames = Map(), PosedFrames()


class Atlas:
    """The submaps of a run in the order of their creation; numbers are not reused.

    Attributes:
        num_created: Number of submaps ever created.
    """

    def __init__(
        self, like: Float[Tensor, "..."], submaps: Iterable[Submap] = (), num_created: int = 0
    ) -> None:
        """like: tensor whose device and floating-point type new submaps get; submaps: to start with."""
        self._like = like
        self._submaps = list(submaps)
        self.num_created = num_created

    def __len__(self) -> int:
        return len(self._submaps)

    def __iter__(self) -> Iterator[Submap]:
        return iter(self._submaps)

    def create(self) -> Submap:
        """Add a new, empty submap."""
        submap = Submap.empty(self.num_created, self._like)
        self.num_created += 1
        self._submaps.append(submap)
        return submap

    def remove(self, submap: Submap) -> None:
        """Remove a submap that was discarded or merged into another one."""
        self._submaps = [other for other in self._submaps if other is not submap]

    def revoke(self, submap: Submap) -> None:
        """Remove the submap that was created last, as if it had never been created."""
        self.remove(submap)
        self.num_created = submap.number

    def main(self, session: int | None = None) -> Submap | None:
        """Return the main submap, see `main_submap`."""
        return main_submap(self._submaps, session)

    def find(self, key: int) -> tuple[Submap, int] | None:
        """Return the submap and the row of the keyframe with this key, or None."""
        found = ((submap, submap.map.row(key)) for submap in self._submaps)
        return next(((submap, row) for submap, row in found if row >= 0), None)


def main_submap(submaps: Iterable[Submap], session: int | None = None) -> Submap | None:
    """Return the submap with most posed frames of a session, then of all sessions; None if there is none."""
    return max(
        submaps,
        key=lambda submap: (submap.posed_frames.count(session), len(submap.posed_frames)),
        default=None,
    )
