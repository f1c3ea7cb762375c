"""Frames whose poses are not believed yet: what is built on them is on trial until the frames after them confirm it."""

from __future__ import annotations

from torch import Tensor

from torchslam.config import Config
from torchslam.map.atlas import TrackingState
from torchslam.types import FrameFeatures, PoseEstimate

PendingFrame = tuple[FrameFeatures, PoseEstimate, Tensor, int]
"""A frame, what was found in it, and its pose T_cr (4, 4) relative to a keyframe."""


MAX_PENDING_FRAMES = 1000
"""Frames held back at a time: none can wait for ever."""


class PoseConfirmation:
    """Holds frames back from the first doubtful one until enough certain ones have followed in a row."""

    def __init__(self, config: Config) -> None:
        self._after_doubt = config.pose_validation.num_confirming_frames
        self._after_return = config.relocalization.num_confirming_frames
        self._held: list[PendingFrame] = []
        self._needed = 0
        self._doubtful = 0  # frames since the last certain one that is believed
        self.is_relocalized = False

    def __bool__(self) -> bool:
        """Whether anything is held back."""
        return self._needed > 0

    @property
    def reason(self) -> str:
        """What is waited for."""
        return f"to be confirmed by {self._needed} more frames"

    def start_after_relocalization(
        self, view: FrameFeatures, estimate: PoseEstimate, tracking: TrackingState
    ) -> None:
        """Begin with a frame that was relocalised."""
        self._held = [(view, estimate, tracking.T_cr, tracking.reference)]
        self._needed, self.is_relocalized = self._after_return, True

    def push(
        self,
        view: FrameFeatures,
        estimate: PoseEstimate,
        tracking: TrackingState,
        doubt: str,
        is_mapped: bool = False,
    ) -> None:
        """Hold a frame back; one without a doubt counts as a confirmation.

        is_mapped: the map grew by what is held back and agrees with it for that reason alone: it takes as many certain
                   frames as there were doubtful ones
        """
        self._held.append((view, estimate, tracking.T_cr, tracking.reference))
        self._doubtful += bool(doubt)
        if doubt:
            self._needed = self._after_return if self.is_relocalized else self._after_doubt
            if is_mapped:
                self._needed = max(self._needed, self._doubtful)
        else:
            self._needed -= 1

    @property
    def is_full(self) -> bool:
        """Whether no more frames can be held back."""
        return len(self._held) >= MAX_PENDING_FRAMES

    def views(self) -> list[FrameFeatures]:
        """The frames that are held back, in order."""
        return [held[0] for held in self._held]

    def confirm(self) -> list[PendingFrame]:
        """What was held back and is believed now; nothing is held any more."""
        self._needed, self._doubtful, self.is_relocalized = 0, 0, False
        return self.pop_all()

    def pop_all(self) -> list[PendingFrame]:
        """What is held back, believed or not; frames that come later still have to confirm the camera's place."""
        held, self._held = self._held, []
        return held
