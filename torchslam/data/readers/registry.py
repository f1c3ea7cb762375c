"""The readers: for each kind of sequence a module that says whether it is one, and opens it."""

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
    """What a module of a reader offers.

    LOOKS_FOR: by what it knows its kind, in words
    """

    LOOKS_FOR: str

    def matches(self, path: str) -> bool:
        """Whether what lies at the path is of its kind."""

    def open(self, path: str, camera: GivenCamera | None, rate: float | None) -> Sequence:
        """Open it. `rate`: frames per second, for kinds without times. Raises SequenceError and its kin."""


# The first that matches opens: those that know a layout by its own files before those that take any image.
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
    """The reader for what lies at the path."""
    return next((reader for reader in READERS if reader.matches(path)), None)
