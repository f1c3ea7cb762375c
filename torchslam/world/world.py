"""A world: what lives and dies together, and moves together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchslam.geometry import rigid, sim3_inverse, sim3_scale, transform
from torchslam.values import Trajectory
from torchslam.world.history import History
from torchslam.world.map import Map
from torchslam.world.track import Track


@dataclass
class World:
    """A map, the frames that were posed in it, and where the camera was last.

    number: what it is called, from 0 in the order in which the worlds of a run began
    asked:  how many of the first keyframes were already asked whether the map needs them
    """

    number: int
    track: Track
    map: Map = field(default_factory=Map)
    history: History = field(default_factory=History)
    asked: int = 0

    @classmethod
    def empty(cls, number: int, like: Tensor) -> World:
        """A world without anything in it; device and floating-point type of `like`."""
        return cls(number, Track.nowhere(like))

    @property
    def T_cw(self) -> Tensor:
        """(4, 4) pose of the last frame, by the map as it is now."""
        return self.track.T_cr @ self.map.T_cw[self.track.reference]

    def trajectory(self, session: int | None = None) -> Trajectory:
        """Every posed frame, of one session or of all, by the map as it is now."""
        return self.history.trajectory(self.map, session)

    def aside(self) -> World:
        """The same map and history with a track of its own: to follow another camera, or the same one backwards."""
        return replace(self, track=replace(self.track))

    def correct(self, S_cw: Tensor) -> None:
        """Put every keyframe to where a similarity S_cw (K, 4, 4), world to camera, has it.

        Its scale says how large a map unit is around the keyframe. Points follow the keyframe that made them, frames
        the one they refer to, and so does the track.
        """
        scale = sim3_scale(S_cw)
        T_cw = rigid(S_cw[:, :3, :3] / scale[:, None, None], S_cw[:, :3, 3] / scale[:, None])
        points, born = self.map.points, self.map.points["born"]
        S_wc = sim3_inverse(S_cw)[born]
        points_c = transform(self.map.T_cw[born], self.map.positions_w[:, None])
        R_wc = S_wc[:, :3, :3] @ self.map.T_cw[born][:, :3, :3]
        points["positions_w"][:] = transform(S_wc, points_c)[:, 0]
        points["covariances_w"][:] = R_wc @ points["covariances_w"] @ R_wc.mT
        points["normals_w"][:] = (scale[born, None, None] * R_wc @ points["normals_w"][..., None])[..., 0]
        points["reach"][:] /= scale[born]
        self.map.keyframes["covariances"][:] = rescaled(self.map.keyframes["covariances"], 1 / scale)
        self.map.keyframes["T_cw"][:] = T_cw
        self.history.rescale(1 / scale)
        if self.track.reference >= 0:
            around = scale[self.track.reference]
            self.track.T_cr = _shrunk(self.track.T_cr, around)
            if self.track.velocity is not None:
                self.track.velocity = _shrunk(self.track.velocity, around)

    def move(self, S_ba: Tensor) -> None:
        """Give the world another frame and unit: points p become S_ba p, S_ba (4, 4) a similarity."""
        self.correct(self.map.T_cw @ sim3_inverse(S_ba))

    def absorb(self, other: World, S_ab: Tensor) -> None:
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
        other.map, other.history = Map(), History()


def _shrunk(T: Tensor, factor: Tensor) -> Tensor:
    """T (4, 4) in a unit of length that is `factor` times as long."""
    return rigid(T[:3, :3], T[:3, 3] / factor)


def rescaled(covariances: Tensor, factor: Tensor) -> Tensor:
    """Covariances (K, 6, 6) of poses whose unit of length changes by factors (K,)."""
    units = torch.ones_like(covariances[..., 0])
    units[:, :3] = factor[:, None]
    return units[:, :, None] * covariances * units[:, None, :]
