"""Registry of the readers: one module per kind of sequence, which recognizes and opens it."""

from __future__ import annotations

from typing import Protocol

from torchslam.data.camera_argument import GivenCamera
from torchslam.data.readers import (
    bag,
    eth3d_tum,
    euroc,
    folder,
    icl_nuim,
    kitti,
    kitti_raw,
    live,
    seven_scenes,
    tartanair,
    video,
)
from torchslam.data.sequence import Sequence
from torchslam.data.synthetic import sequence as synthetic


class Reader(Protocol):
    """Interface of a reader module.

    LOOKS_FOR: description of the files by which it recognizes its kind.
    """

    LOOKS_FOR: str

    def matches(self, path: str) -> bool:
        """Return True for a path of its kind."""

    def open(self, path: str, camera: GivenCamera | None, rate: float | None) -> Sequence:
        """Open it. `rate`: frames per second, for kinds without times. Raises SequenceError and its kin."""


# The first match is used: readers of specific layouts precede those of plain images.
READERS: tuple[Reader, ...] = (
    synthetic,
    live,
    video,
    bag,
    icl_nuim,
    eth3d_tum,
    kitti,
    kitti_raw,
    euroc,
    seven_scenes,
    tartanair,
    folder,
)


def find_reader(path: str) -> Reader | None:
    """Return the reader for a path; None if there is none."""
    return next((reader for reader in READERS if reader.matches(path)), None)
