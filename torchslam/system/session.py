"""A session: one run of frames over an atlas, and the components that process them.

A session starts with an empty atlas, with that of a map file, or where a checkpoint was written.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from torchslam.config import Config
from torchslam.errors import ResultsError
from torchslam.geometry import Camera, SharedCamera
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.map.atlas import Atlas, Submap
from torchslam.map.file import read_atlas, write_atlas
from torchslam.mapping.mapper import Mapper
from torchslam.system.frame_log import FrameLog
from torchslam.system.modes import Mode
from torchslam.system.online_camera import OnlineCamera
from torchslam.system.savepoint import Savepoint
from torchslam.tracking.non_static import SceneFilter
from torchslam.tracking.tracker import Tracker
from torchslam.types import Matcher
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


@dataclass
class ActiveMap:
    """The active submap, and what a loss of the camera would take back.

    Attributes:
        submap: The submap in which the camera is tracked; None while it is lost.
        provisional: Savepoint from before the submap, which may be discarded; None once it is confirmed.
        doubted: Savepoint from before the frames that are held back; None without such frames.
    """

    submap: Submap | None = None
    provisional: Savepoint | None = None
    doubted: Savepoint | None = None

    @property
    def current(self) -> Submap:
        """The active submap, where there must be one."""
        assert self.submap is not None
        return self.submap

    def mode(self, num_submaps: int) -> Mode:
        """The mode, given the number of submaps of the atlas."""
        if self.submap is None:
            return Mode.LOST if num_submaps else Mode.INITIALIZING
        if self.provisional is not None:
            return Mode.PROVISIONAL if self.doubted is None else Mode.PROVISIONAL_DOUBTED
        if self.doubted is None:
            return Mode.TRACKING
        return Mode.RELOCALIZED if self.doubted.is_relocalized else Mode.DOUBTED


@dataclass(frozen=True)
class SystemContext:
    """The components of one session.

    Attributes:
        log: The frames whose poses are not final.
        active_map: The active submap and the savepoints.
    """

    camera: SharedCamera
    config: Config
    clock: Stopwatch
    matcher: Matcher
    tracker: Tracker
    mapper: Mapper
    session: Session
    loop_closer: LoopCloser
    scene_filter: SceneFilter
    online_camera: OnlineCamera
    log: FrameLog
    active_map: ActiveMap

    @property
    def mode(self) -> Mode:
        """The mode after the last frame."""
        return self.active_map.mode(len(self.session.atlas))
