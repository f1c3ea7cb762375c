"""A world: what lives and dies together, and moves together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from torch import Tensor

from torchslam.geometry import sim3_inverse, sim3_scale
from torchslam.geometry.correction import (
    carry_points,
    covariances_with_unit,
    with_unit,
    without_scale,
)
from torchslam.map.map import Map
from torchslam.map.posed_frames import PosedFrames
from torchslam.map.tracking_state import TrackingState
from torchslam.types import Trajectory


@dataclass
class Submap:
    """A map, the frames that were posed in it, and where the camera was last.

    number: what it is called, from 0 in the order in which the worlds of a run began
    asked:  how many of the first keyframes were already asked whether the map needs them
    """

    number: int
    track: TrackingState
    map: Map = field(default_factory=Map)
    history: PosedFrames = field(default_factory=PosedFrames)
    asked: int = 0

    @classmethod
    def empty(cls, number: int, like: Tensor) -> Submap:
        """A world without anything in it; device and floating-point type of `like`."""
        return cls(number, TrackingState.nowhere(like))

    @property
    def T_cw(self) -> Tensor:
        """(4, 4) pose of the last frame, by the map as it is now."""
        return self.track.T_cr @ self.map.T_cw[self.track.reference]

    def trajectory(self, session: int | None = None) -> Trajectory:
        """Every posed frame, of one session or of all, by the map as it is now."""
        return self.history.trajectory(self.map, session)

    def aside(self) -> Submap:
        """The same map and history with a track of its own: to follow another camera, or the same one backwards."""
        return replace(self, track=replace(self.track))

    def correct(self, S_cw: Tensor) -> None:
        """Put every keyframe to where a similarity S_cw (K, 4, 4), world to camera, has it.

        Its scale says how large a map unit is around the keyframe. Points follow the keyframe that made them, frames
        the one they refer to, and so does the track.
        """
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
        self.history.rescale(1 / scale)
        if self.track.reference >= 0:
            around = scale[self.track.reference]
            self.track.T_cr = with_unit(self.track.T_cr, around)
            if self.track.velocity is not None:
                self.track.velocity = with_unit(self.track.velocity, around)

    def move(self, S_ba: Tensor) -> None:
        """Give the world another frame and unit: points p become S_ba p, S_ba (4, 4) a similarity."""
        self.correct(self.map.T_cw @ sim3_inverse(S_ba))

    def absorb(self, other: Submap, S_ab: Tensor) -> None:
        """Take over everything of another world, moved by S_ab (4, 4) into this one; the other is empty afterwards.

        Rows of the other's keyframes, points and frames are appended to this one's. The camera stays where it was
        last, in the other world.
        """
        other.move(S_ab)
        keyframes, points = self.map.append(other.map)
        self.history.append(other.history, keyframes, points)
        track = other.track
        self.track = replace(
            track,
            reference=track.reference + keyframes,
            seen_last=track.seen_last + points,
            local_keyframes=track.local_keyframes + keyframes,
            local_points=track.local_points + points,
        )
        other.map, other.history = Map(), PosedFrames()
