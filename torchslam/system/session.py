"""A session: one run of frames over worlds. It begins without any, in those of a file, or where a run was cut.

`torchslam.system.slam.SLAM` enters a session and changes its worlds, frame by frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.map.atlas import Atlas
from torchslam.map.file import read_atlas, write_atlas


@dataclass(frozen=True)
class Session:
    """One run of frames over worlds.

    camera:  of its frames and of those of all sessions before
    worlds:  what is known, and what becomes of it
    number:  of the session among those over the same worlds, from 0
    mapping: whether keyframes, points and worlds are made; without it, frames are only localised: nothing changes
    """

    camera: Camera
    worlds: Atlas
    number: int = 0
    mapping: bool = True

    @classmethod
    def load(cls, path: str | Path, mapping: bool = True, device: torch.device | str = "cpu") -> Session:
        """A further one, in the worlds of a file that `save` wrote.

        Raises ResultsError for a file that is missing, damaged, or without a world to localise in.
        """
        saved = read_atlas(path, device)
        if not mapping and len(saved.worlds) == 0:
            raise ResultsError(f"{path}: there is no world in it to localise in")
        for world in saved.worlds if mapping else ():
            world.map.forget_frames()
        return cls(saved.camera, saved.worlds, saved.sessions, mapping)

    def save(self, path: str | Path) -> None:
        """Write worlds and camera to a file, whole or not at all; frames that were only localised are left out."""
        write_atlas(path, self.worlds, self.camera, self.count)

    @property
    def count(self) -> int:
        """How many sessions the worlds know: this one too, unless it only localises."""
        return self.number + int(self.mapping)
