"""A sequence: images in the order of time, the camera that took them and, where known, the true path."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import torch
from torch import Tensor

from torchslam.data.association import interpolate_poses
from torchslam.errors import SequenceError
from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_inverse
from torchslam.values import Frame, Trajectory

GROUNDTRUTH_TOLERANCE = 0.02
"""Seconds between an image and the nearest ground-truth pose beyond which the image counts as without one."""


class Sequence(ABC):
    """Frames by index, read when asked for; a reader supplies `image` and `image_name`.

    name:        what the sequence is called
    kind:        what it was read from, in words
    camera:      intrinsics, with the size of the images
    timestamps:  (N,) float64 seconds, strictly increasing
    groundtruth: the true trajectory at its own rate, or None
    """

    def __init__(
        self, name: str, kind: str, camera: Camera, timestamps: Tensor, groundtruth: Trajectory | None = None
    ) -> None:
        self.name = name
        self.kind = kind
        self.camera = camera
        self.timestamps = timestamps
        self.groundtruth = groundtruth
        self._T_cw: Tensor | None = None
        self._has_pose = torch.zeros(len(timestamps), dtype=torch.bool)
        if groundtruth is not None:
            T_wc, self._has_pose = interpolate_poses(groundtruth, timestamps, GROUNDTRUTH_TOLERANCE)
            self._T_cw = se3_inverse(T_wc)

    @abstractmethod
    def image(self, index: int) -> Tensor:
        """(1, 1, H, W) float32 in [0, 1]. Raises FrameError where it cannot be read or has another size."""

    def colour(self, index: int) -> Tensor:
        """(H, W, 3) uint8 red, green, blue; three times the same where the sequence is grey. Raises FrameError."""
        return (self.image(index)[0, 0, :, :, None] * 255.0).round().to(torch.uint8).expand(-1, -1, 3)

    @abstractmethod
    def image_name(self, index: int) -> str:
        """What the image is called in messages."""

    def __len__(self) -> int:
        return int(self.timestamps.shape[0])

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError where its image cannot be read, IndexError beyond the end."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        index %= len(self)
        return Frame(
            index=index,
            timestamp=float(self.timestamps[index]),
            image=self.image(index),
            name=self.image_name(index),
            T_cw_groundtruth=self.pose(index),
        )

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def pose(self, index: int) -> Tensor | None:
        """(4, 4) float64 true T_cw of frame `index` without reading its image; None where it is unknown."""
        if self._T_cw is None or not self._has_pose[index]:
            return None
        return self._T_cw[index]

    def part(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Sequence:
        """Every `stride`-th frame from `start` to before `stop`, numbered from 0 again.

        Raises SequenceError where that leaves none.
        """
        if stride < 1:
            raise SequenceError(f"{self.name}: the stride must be positive, not {stride}")
        indices = range(len(self))[start:stop:stride]
        if not indices:
            raise SequenceError(f"{self.name}: no frames left of {len(self)}")
        return _Part(self, indices)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.camera.size

    @property
    def frame_rate(self) -> float:
        """Frames per second, from the median interval; 0 for a single frame."""
        if len(self) < 2:
            return 0.0
        return 1.0 / float(self.timestamps.diff().median())

    def describe(self) -> dict[str, str]:
        """What `torchslam info` prints, label by label."""
        duration = float(self.timestamps[-1] - self.timestamps[0])
        numbers = " ".join(f"{number:.6g}" for number in self.camera.params.tolist())
        truth = "none"
        if self.groundtruth is not None:
            length = float(self.groundtruth.positions_w.diff(dim=0).norm(dim=-1).sum())
            with_pose = int(self._has_pose.sum())
            truth = f"{len(self.groundtruth)} poses, {length:.2f} m, for {with_pose} of {len(self)} frames"
        return {
            "name": self.name,
            "kind": self.kind,
            "frames": str(len(self)),
            "size": f"{self.size[0]}x{self.size[1]}",
            "rate": f"{self.frame_rate:.2f} Hz over {duration:.2f} s",
            "camera": f"{self.camera.model} {numbers}",
            "ground truth": truth,
        }


class _Part(Sequence):
    """A range of another sequence's frames."""

    def __init__(self, whole: Sequence, indices: range) -> None:
        super().__init__(
            whole.name, whole.kind, whole.camera, whole.timestamps[list(indices)], whole.groundtruth
        )
        self._whole = whole
        self._indices = indices

    def image(self, index: int) -> Tensor:
        return self._whole.image(self._indices[index])

    def colour(self, index: int) -> Tensor:
        return self._whole.colour(self._indices[index])

    def image_name(self, index: int) -> str:
        return self._whole.image_name(self._indices[index])
