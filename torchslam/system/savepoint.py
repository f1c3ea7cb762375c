"""Savepoints: what a loss of the camera takes back, and how many certain frames make it final.

A stretch of doubtful frames begins with a savepoint, whose rollback restores the map from before the first tentative
keyframe. A provisional map is one from before the submap: its rollback removes that (`MapStart`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from torchslam.map.atlas import Submap, TrackingState
from torchslam.map.map import MapSnapshot
from torchslam.types import Explanation, Reason, Rejection

MAX_HELD_FRAMES = 1000
"""Frames that are held back at most, so that memory is bounded: about 100 MB of ORB features. Tried at this value
only."""
MANY_HELD_FRAMES = 40
"""Frames that are held back and kept when the camera is lost: a wrong pose does not last that long."""


@dataclass
class Savepoint:
    """The state that a map goes back to if the camera is lost, the frames since, and the rule that commits it.

    Attributes:
        submap: The submap that changes.
        num_confirming: Certain frames that commit it: in a row after a doubtful one, or in all for a new map.
        is_relocalized: Whether it was set where the camera was relocalized.
        frames: Indices of the frames since, which the frame log has.
        needed: Certain frames that still have to follow.
        num_certain: Certain frames so far.
        num_doubtful: Doubtful frames so far.
    """

    submap: Submap
    num_confirming: int
    is_relocalized: bool = False
    frames: list[int] = field(default_factory=list)
    num_certain: int = 0
    num_doubtful: int = 0
    _before: tuple[MapSnapshot, TrackingState] | None = None

    def __post_init__(self) -> None:
        """Start the countdown."""
        self.needed = self.num_confirming

    def count(self, rejection: Rejection | None = None) -> None:
        """Count a frame: a certain one counts down, a doubtful one starts the countdown again.

        Tentative keyframes agree with frames by construction: with some, as many certain frames are needed as there
        were doubtful ones.
        """
        if rejection is None:
            self.num_certain += 1
            self.needed -= 1
            return
        self.num_doubtful += 1
        self.needed = self.num_confirming
        if self.has_keyframes:
            self.needed = max(self.needed, self.num_doubtful)

    @property
    def is_open(self) -> bool:
        """Whether certain frames still have to follow."""
        return self.needed > 0

    @property
    def is_full(self) -> bool:
        """Whether no more frames can be held back."""
        return len(self.frames) >= MAX_HELD_FRAMES

    @property
    def is_long(self) -> bool:
        """Whether frames are held back for so long that their poses are kept even if the camera is lost."""
        return len(self.frames) >= MANY_HELD_FRAMES

    @property
    def reason(self) -> Explanation:
        """Number of frames that have to confirm those held back."""
        return Explanation.of(Reason.UNCONFIRMED, count=self.needed)

    @property
    def has_keyframes(self) -> bool:
        """Whether there are tentative keyframes."""
        return self._before is not None

    @property
    def keyframes(self) -> range:
        """Rows of the tentative keyframes."""
        count = self.submap.map.num_keyframes
        return range(count if self._before is None else self._before[0].num_keyframes, count)

    def save_map(self) -> None:
        """Save the map before its first tentative keyframe; until then there is nothing to restore."""
        if self._before is None:
            self._before = MapSnapshot.of(self.submap.map), replace(self.submap.tracking)

    def commit(self) -> None:
        """Keep what changed since; frames that follow are counted on."""
        self._before, self.frames = None, []

    def rollback(self) -> None:
        """Restore map and tracking state from before the first tentative keyframe."""
        if self._before is not None:
            (before, self.submap.tracking), self._before = self._before, None
            before.restore(self.submap.map)
