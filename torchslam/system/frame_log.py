"""The frame log: the one owner of all frames whose poses are not final."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from jaxtyping import Float
from torch import Tensor

from torchslam.map.atlas import TrackingState
from torchslam.types import FrameFeatures, PoseEstimate

MAX_UNPOSED_FRAMES = 1000
"""Frames without a pose that are kept and posed once there is a map: more than those since the reference frame, with
which a map may begin, and about 100 MB of ORB features. Tried at this value only."""


class FrameStatus(Enum):
    """What the log knows of a frame."""

    UNPOSED = "no pose: backward tracking may find one"
    HELD = "a pose that later frames have to confirm"
    POSED = "a pose in a provisional map, which may be discarded"


@dataclass(frozen=True)
class HeldFrame:
    """A frame with a pose that is not in the map yet.

    Attributes:
        view: The frame.
        estimate: Its pose.
        T_cr: Its pose relative to a keyframe.
        reference: The row of that keyframe.
    """

    view: FrameFeatures
    estimate: PoseEstimate
    T_cr: Float[Tensor, "4 4"]
    reference: int

    @classmethod
    def of(cls, view: FrameFeatures, estimate: PoseEstimate, tracking: TrackingState) -> HeldFrame:
        """Hold a frame with the tracking state after it."""
        return cls(view, estimate, tracking.T_cr, tracking.reference)


class FrameLog:
    """Frames of a session by index, with their status; frames with a final pose are not in it.

    Of the unposed ones the latest `MAX_UNPOSED_FRAMES` are kept.
    """

    def __init__(self) -> None:
        self._frames: dict[int, tuple[FrameStatus, FrameFeatures | HeldFrame]] = {}

    def status(self, index: int) -> FrameStatus | None:
        """The status of a frame; None for one that is not in the log."""
        return self._frames[index][0] if index in self._frames else None

    def unposed(self, before: int | None = None) -> list[FrameFeatures]:
        """The unposed frames in order of their index, at most those before a frame."""
        return [
            self.view(index) for index in self._of(FrameStatus.UNPOSED) if before is None or index < before
        ]

    def view(self, index: int) -> FrameFeatures:
        """The features of a frame."""
        _, frame = self._frames[index]
        return frame.view if isinstance(frame, HeldFrame) else frame

    def views(self, indices: Iterable[int]) -> list[FrameFeatures]:
        """The features of frames in order of their index."""
        return [self.view(index) for index in sorted(indices)]

    def unpose(self, *views: FrameFeatures) -> None:
        """Log frames without a pose."""
        self._log(FrameStatus.UNPOSED, {view.index: view for view in views})
        unposed = self._of(FrameStatus.UNPOSED)
        self.forget(unposed[: max(0, len(unposed) - MAX_UNPOSED_FRAMES)])

    def hold(self, frame: HeldFrame) -> None:
        """Log a frame with a pose that later frames have to confirm."""
        self._log(FrameStatus.HELD, {frame.view.index: frame})

    def pose(self, *views: FrameFeatures) -> None:
        """Log frames with poses in a provisional map."""
        self._log(FrameStatus.POSED, {view.index: view for view in views})

    def release(self, indices: Iterable[int]) -> None:
        """Frames that were held or posed are unposed again."""
        self.unpose(*self.views(indices))

    def take_held(self, indices: Iterable[int]) -> list[HeldFrame]:
        """Return and forget held frames, in the given order."""
        frames = []
        for index in indices:
            _, frame = self._frames.pop(index)
            assert isinstance(frame, HeldFrame), f"frame {index} is not held"
            frames.append(frame)
        return frames

    def forget(self, indices: Iterable[int]) -> None:
        """Forget frames: their poses are final, or nothing can pose them."""
        for index in indices:
            self._frames.pop(index, None)

    def copy(self) -> FrameLog:
        """A log of the same frames, which later frames do not change."""
        copied = FrameLog()
        copied._frames = dict(self._frames)
        return copied

    def restore(self, copied: FrameLog) -> None:
        """Go back to the frames of a copy."""
        self._frames = dict(copied._frames)

    def _of(self, status: FrameStatus) -> list[int]:
        return sorted(index for index, (each, _) in self._frames.items() if each is status)

    def _log(self, status: FrameStatus, frames: dict[int, FrameFeatures] | dict[int, HeldFrame]) -> None:
        for index, frame in frames.items():
            self._frames[index] = status, frame
