"""A sequence of image files: what the readers of ETH3D, TUM, KITTI, EuRoC and plain folders all end in."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence as Listed
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchslam.data.calibration import Calibration, fit_camera, size_text
from torchslam.data.image_file import read_colour, read_grey
from torchslam.data.sequence import Sequence
from torchslam.data.text_file import check_later
from torchslam.errors import FrameError, SequenceError
from torchslam.geometry.camera import Camera
from torchslam.values import Trajectory

ATTEMPTS = 20
"""Unreadable images after which a sequence is given up."""


@dataclass(frozen=True)
class ImageEntry:
    """One image of a list.

    timestamp: seconds
    path:      of the image file
    where:     the list's file and line that name it, or the image itself, for messages
    """

    timestamp: float
    path: Path
    where: str


class ImageSequence(Sequence):
    """Images from files, decoded when asked for."""

    def __init__(
        self,
        name: str,
        kind: str,
        entries: Listed[ImageEntry],
        camera: Camera | Calibration,
        groundtruth: Trajectory | None = None,
    ) -> None:
        """Raises SequenceError without images, for timestamps out of order or doubled, or where none of the
        first images can be read; CalibrationError for a camera of another image size."""
        _check_order(name, entries)
        size = _find_size(entries)
        camera = fit_camera(camera, size, name)
        timestamps = torch.tensor([entry.timestamp for entry in entries], dtype=torch.float64)
        super().__init__(name, kind, camera, timestamps, groundtruth)
        self._entries = entries

    def image(self, index: int) -> Tensor:
        entry = self._entries[index]
        image = read_grey(entry.path, entry.where)
        self._check_size(entry, (image.shape[-1], image.shape[-2]))
        return image

    def colour(self, index: int) -> Tensor:
        entry = self._entries[index]
        image = read_colour(entry.path, entry.where)
        self._check_size(entry, (image.shape[1], image.shape[0]))
        return image

    def image_name(self, index: int) -> str:
        return str(self._entries[index].path)

    def _check_size(self, entry: ImageEntry, size: tuple[int, int]) -> None:
        if size != self.size:
            raise FrameError(
                f"{entry.where}: {entry.path} is {size_text(size)}, the others are {size_text(self.size)}"
            )


def _check_order(name: str, entries: Listed[ImageEntry]) -> None:
    if not entries:
        raise SequenceError(f"{name}: no images")
    for before, entry in itertools.pairwise(entries):
        check_later(entry.timestamp, before.timestamp, entry.where, SequenceError)


def _find_size(entries: Listed[ImageEntry]) -> tuple[int, int]:
    """(width, height) that most of the first three readable images have: the first may be the odd one."""
    sizes: list[tuple[int, int]] = []
    failures: list[FrameError] = []
    for entry in entries:
        try:
            image = read_grey(entry.path, entry.where)
        except FrameError as failure:
            failures.append(failure)
        else:
            sizes.append((image.shape[-1], image.shape[-2]))
        if len(sizes) == 3 or len(failures) == ATTEMPTS:
            break
    if not sizes:
        raise SequenceError(f"none of the first {len(failures)} images can be read; the first: {failures[0]}")
    return Counter(sizes).most_common(1)[0][0]
