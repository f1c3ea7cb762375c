"""A session: one run of frames over an atlas, and the components that process them.

A session starts with an empty atlas, with that of a map file, or where a checkpoint was written.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from torchslam.config import Config
from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.map.atlas import Atlas, Submap
from torchslam.map.file import read_atlas, write_atlas
from torchslam.mapping.mapper import Mapper
from torchslam.tracking.non_static import NonStaticFilter
from torchslam.tracking.pose_validation import PoseConfirmation
from torchslam.tracking.tracker import Tracker
from torchslam.types import Matcher, State
from torchslam.utils.timing import Stopwatch


@dataclass(frozen=True)
class Session:
    """One run of frames over an atlas.

    Attributes:
        camera: camera of the frames of this and of all earlier sessions
        atlas: the submaps; the session changes them if `mapping`
        number: number of the session among those over the same atlas, from 0
        mapping: create keyframes, points and submaps; otherwise only localize frames
    """

    camera: Camera
    atlas: Atlas
    number: int = 0
    mapping: bool = True

    @classmethod
    def load(cls, path: str | Path, mapping: bool = True, device: torch.device | str = "cpu") -> Session:
        """Create the next session over the atlas of a map file.

        Args:
            path: the map file.
            mapping: False to localize frames only.
            device: device of the map.

        Raises:
            ResultsError: if the file is missing, damaged, or has no submap to localize in.
        """
        saved = read_atlas(path, device)
        if not mapping and len(saved.atlas) == 0:
            raise ResultsError(f"{path}: there is no submap in it to localize in")
        for submap in saved.atlas if mapping else ():
            submap.map.reset_last_seen()
        return cls(saved.camera, saved.atlas, saved.sessions, mapping)

    def save(self, path: str | Path) -> None:
        """Write atlas and camera to a map file, atomically; frames that were only localized are left out."""
        write_atlas(path, self.atlas, self.camera, self.count)

    @property
    def count(self) -> int:
        """Number of sessions of the atlas, this one included unless it only localizes."""
        return self.number + int(self.mapping)


class ActiveMap:
    """The submap in which the camera is tracked, if any, and the state of the system."""

    def __init__(self, submap: Submap | None, state: State) -> None:
        self._submap, self._state = submap, state

    @property
    def submap(self) -> Submap | None:
        """The active submap; None while there is none."""
        return self._submap

    @property
    def state(self) -> State:
        """State after the last frame."""
        return self._state

    @property
    def current(self) -> Submap:
        """The active submap, where there must be one."""
        assert self._submap is not None
        return self._submap

    def activate(self, submap: Submap, state: State) -> None:
        """Track the camera in a submap from now on."""
        self._submap, self._state = submap, state

    def replace(self, submap: Submap) -> None:
        """Go on in the submap that the active one was merged into."""
        self._submap = submap

    def set_state(self, state: State) -> None:
        """Change the state alone."""
        self._state = state

    def deactivate(self, state: State) -> None:
        """Stop tracking: the camera is lost, or its map was discarded."""
        self._submap, self._state = None, state


@dataclass(frozen=True)
class SystemContext:
    """The components of one session.

    Attributes:
        config: configuration for images of the camera's size, see `Config.for_size`
    """

    camera: Camera
    config: Config
    clock: Stopwatch
    matcher: Matcher
    tracker: Tracker
    mapper: Mapper
    session: Session
    loop_closer: LoopCloser
    non_static_filter: NonStaticFilter
    confirmation: PoseConfirmation
    active_map: ActiveMap
