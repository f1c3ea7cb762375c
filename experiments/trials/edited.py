"""A sequence of frames of other sequences, in any order, with edited images."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.data.formats.image_file import gray_to_tensor
from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera, se3_inverse
from torchslam.types import Trajectory

RATE = 30.0
"""Frames per second of the edited sequence, independent of its parts."""

Edit = Callable[[np.ndarray, int], np.ndarray]
"""From a gray image (H, W) uint8 and the number of the frame in the edited sequence to another image."""


@dataclass(frozen=True)
class Shot:
    """One frame of an edited sequence.

    source, index: the sequence and the frame that it is taken from
    edit:          what is done to its image
    T_cw:          (4, 4) its true pose, where that is known
    belongs:       whether it shows the scene, so that it can be posed; where it does not there is no pose
    """

    source: Sequence
    index: int
    edit: Edit | None = None
    T_cw: Tensor | None = None
    belongs: bool = True


def shots(source: Sequence, indices: Iterable[int], edit: Edit | None = None) -> list[Shot]:
    """Frames of a sequence with their true poses."""
    return [Shot(source, index, edit, source.pose(index)) for index in indices]


def strangers(source: Sequence, indices: Iterable[int], edit: Edit | None = None) -> list[Shot]:
    """Frames that do not show the scene."""
    return [Shot(source, index, edit, belongs=False) for index in indices]


class Edited(Sequence):
    """A sequence of shots.

    belongs: (N,) bool, the frames that can be posed
    """

    def __init__(self, name: str, camera: Camera, parts: list[Shot], rate: float = RATE) -> None:
        timestamps = torch.arange(len(parts), dtype=torch.float64) / rate
        poses = {row: shot.T_cw for row, shot in enumerate(parts) if shot.T_cw is not None and shot.belongs}
        truth = None
        if poses:
            T_cw = torch.stack(list(poses.values())).to(torch.float64)
            truth = Trajectory(timestamps[list(poses)], se3_inverse(T_cw))
        super().__init__(name, "edited", camera, timestamps, truth)
        self.belongs = torch.tensor([shot.belongs for shot in parts])
        self._shots = parts
        self._T_cw_of = poses

    def pose(self, index: int) -> Tensor | None:
        """(4, 4) true T_cw of a frame; None where it is unknown. Never that of a neighbor in time."""
        return self._T_cw_of.get(index)

    def image(self, index: int) -> Tensor:
        shot = self._shots[index]
        gray = np.rint(255 * shot.source.image(shot.index)[0, 0].numpy()).astype(np.uint8)
        if shot.edit is not None:
            gray = shot.edit(gray, index)
        return gray_to_tensor(fitted(gray, self.size))

    def image_name(self, index: int) -> str:
        shot = self._shots[index]
        return f"{self.name}#{index}, from {shot.source.image_name(shot.index)}"


def fitted(gray: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The image (H, W) with another (width, height)."""
    height, width = gray.shape
    if (width, height) == size:
        return np.ascontiguousarray(gray)
    shrinks = size[0] <= width and size[1] <= height
    return cv2.resize(gray, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
