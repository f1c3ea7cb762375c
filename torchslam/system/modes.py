"""The modes of a session, and how a frame changes them."""

from __future__ import annotations

from enum import Enum

from torchslam.types import State


class Mode(Enum):
    """What the system does with a frame."""

    INITIALIZING = "initializing"
    LOST = "lost"
    PROVISIONAL = "tracking in a provisional map"
    PROVISIONAL_DOUBTED = "tracking in a provisional map, frames are held back"
    TRACKING = "tracking"
    DOUBTED = "tracking, frames are held back"
    RELOCALIZED = "relocalized, frames are held back"

    @property
    def state(self) -> State:
        """The state that users see."""
        return _STATES[self]


_STATES = {
    Mode.INITIALIZING: State.INITIALIZING,
    Mode.LOST: State.LOST,
    Mode.PROVISIONAL: State.TRACKING,
    Mode.PROVISIONAL_DOUBTED: State.UNCERTAIN,
    Mode.TRACKING: State.TRACKING,
    Mode.DOUBTED: State.UNCERTAIN,
    Mode.RELOCALIZED: State.UNCERTAIN,
}
"""The state of each mode."""

TRANSITIONS: dict[tuple[Mode, Mode], str] = {
    (Mode.INITIALIZING, Mode.PROVISIONAL): "two views give a map",
    (Mode.LOST, Mode.PROVISIONAL): "two views give a map",
    (Mode.LOST, Mode.RELOCALIZED): "the place is recognized",
    (Mode.PROVISIONAL, Mode.TRACKING): "enough certain frames, or a known map agrees",
    (Mode.PROVISIONAL, Mode.PROVISIONAL_DOUBTED): "a doubtful pose",
    (Mode.PROVISIONAL, Mode.DOUBTED): "a known map agrees, and a doubtful pose",
    (Mode.PROVISIONAL, Mode.INITIALIZING): "no pose: the map is discarded",
    (Mode.PROVISIONAL, Mode.LOST): "no pose: the map is discarded unless it has grown",
    (Mode.PROVISIONAL_DOUBTED, Mode.PROVISIONAL): "enough certain frames in a row",
    (Mode.PROVISIONAL_DOUBTED, Mode.TRACKING): "enough certain frames in a row, and a known map agrees",
    (Mode.PROVISIONAL_DOUBTED, Mode.DOUBTED): "no more frames can be held back, and a known map agrees",
    (Mode.PROVISIONAL_DOUBTED, Mode.INITIALIZING): "no pose: the map is discarded",
    (Mode.PROVISIONAL_DOUBTED, Mode.LOST): "no pose: the map is discarded unless it has grown",
    (Mode.TRACKING, Mode.DOUBTED): "a doubtful pose",
    (Mode.TRACKING, Mode.LOST): "no pose",
    (Mode.DOUBTED, Mode.TRACKING): "enough certain frames in a row",
    (Mode.DOUBTED, Mode.LOST): "no pose: back to the savepoint",
    (Mode.RELOCALIZED, Mode.TRACKING): "enough certain frames in a row",
    (Mode.RELOCALIZED, Mode.LOST): "no pose: back to the savepoint",
}
"""What leads from one mode to another with one frame. A mode may also stay."""
