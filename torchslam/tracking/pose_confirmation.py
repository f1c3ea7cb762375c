"""Confirmation of uncertain poses by the frames that follow them."""

from __future__ import annotations

from torch import Tensor

from torchslam.config import Config
from torchslam.map.atlas import TrackingState
from torchslam.types import FrameFeatures, PoseEstimate, Rejection

PendingFrame = tuple[FrameFeatures, PoseEstimate, Tensor, int]
"""A frame, its pose estimate, its pose T_cr (4, 4) relative to a keyframe, and the row of that keyframe."""

MAX_PENDING_FRAMES = 1000
"""Frames that are held back at most."""


class PoseConfirmation:
    """Buffer of the frames since the first uncertain one, with a countdown of certain frames that confirm them."""

    def __init__(self, config: Config) -> None:
        self._needed_after_rejection = config.pose_validation.num_confirming_frames
        self._needed_after_relocalization = config.relocalization.num_confirming_frames
        self._pending: list[PendingFrame] = []
        self._needed = 0
        self._num_rejected = 0  # since the last confirmation
        self.is_relocalized = False

    @property
    def is_holding(self) -> bool:
        """Whether frames have to be confirmed."""
        return self._needed > 0

    @property
    def reason(self) -> str:
        """The countdown, as text."""
        return f"to be confirmed by {self._needed} more frames"

    def start_after_relocalization(
        self, view: FrameFeatures, estimate: PoseEstimate, tracking: TrackingState
    ) -> None:
        """Start again with a relocalized frame."""
        self._pending = [(view, estimate, tracking.T_cr, tracking.reference)]
        self._needed, self.is_relocalized = self._needed_after_relocalization, True

    def push(
        self,
        view: FrameFeatures,
        estimate: PoseEstimate,
        tracking: TrackingState,
        rejection: Rejection | None,
        is_mapped: bool = False,
    ) -> None:
        """Hold a frame back; one without a rejection counts as a confirmation.

        Args:
            rejection: result of the pose validation
            is_mapped: there are tentative keyframes, which agree with frames by construction: as many certain frames
                are needed as there were rejected ones
        """
        self._pending.append((view, estimate, tracking.T_cr, tracking.reference))
        if rejection is None:
            self._needed -= 1
            return
        self._num_rejected += 1
        self._needed = (
            self._needed_after_relocalization if self.is_relocalized else self._needed_after_rejection
        )
        if is_mapped:
            self._needed = max(self._needed, self._num_rejected)

    @property
    def is_full(self) -> bool:
        """Whether no more frames can be held back."""
        return len(self._pending) >= MAX_PENDING_FRAMES

    def views(self) -> list[FrameFeatures]:
        """The pending frames, in order."""
        return [frame[0] for frame in self._pending]

    def confirm(self) -> list[PendingFrame]:
        """Remove and return the pending frames, and reset the countdown."""
        self._needed, self._num_rejected, self.is_relocalized = 0, 0, False
        return self.pop_all()

    def pop_all(self) -> list[PendingFrame]:
        """Remove and return the pending frames; the countdown goes on."""
        pending, self._pending = self._pending, []
        return pending
