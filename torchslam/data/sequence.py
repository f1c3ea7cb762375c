"""A sequence: images in the order of time, the camera that took them and, where known, the true path."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from enum import Enum
from typing import Any

import torch
from torch import Tensor

from torchslam.data.association import interpolate_poses
from torchslam.errors import CalibrationError, SequenceError
from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_inverse
from torchslam.types import Features, Frame, Trajectory

GROUNDTRUTH_TOLERANCE = 0.02
"""Seconds between an image and the nearest ground-truth pose beyond which the image counts as without one."""


class EndOfSequence(IndexError):
    """A sequence whose length was not known in advance, a live source, has no more frames."""


class Calibrated(Enum):
    """What is known of a sequence's camera."""

    GIVEN = "given"
    """By the user, with the data, or found out by the images."""
    GUESSED = "guessed"
    """Only near the truth: a field of view, the focal length of EXIF."""
    MISSING = "missing"
    """The images decide."""


class Sequence(ABC):
    """Frames by index, read when asked for; a reader supplies `image` and `image_name`.

    name:        what the sequence is called
    kind:        what it was read from, in words
    size:        (width, height) of the images, pixels
    calibrated:  whether the camera was given, by the user or with the data, or guessed (a focal length from EXIF or a
                 field of view), or is missing
    timestamps:  (N,) float64 seconds, strictly increasing
    groundtruth: the true trajectory at its own rate, or None
    notes:       what a user should know about how it was read: one line each
    """

    def __init__(
        self,
        name: str,
        kind: str,
        camera: Camera | None,
        timestamps: Tensor,
        groundtruth: Trajectory | None = None,
        *,
        size: tuple[int, int] | None = None,
        guessed: bool = False,
        notes: Iterable[str] = (),
    ) -> None:
        """size: of the images; needed where there is no camera; guessed: whether the camera is only near the truth."""
        self.name = name
        self.kind = kind
        known = size if camera is None else camera.size
        if known is None:
            raise ValueError("a sequence without a camera needs the size of its images")
        self.size = known
        self._camera = camera
        self.calibrated = Calibrated.GUESSED if guessed else Calibrated.GIVEN
        if camera is None:
            self.calibrated = Calibrated.MISSING
        self.timestamps = timestamps
        self.groundtruth = groundtruth
        self.notes = tuple(notes)
        self.holder: object = None  # of what must not go before the sequence does: unpacked files
        self._T_cw: Tensor | None = None
        self._has_pose = torch.zeros(len(timestamps), dtype=torch.bool)
        if groundtruth is not None:
            T_wc, self._has_pose = interpolate_poses(groundtruth, timestamps, GROUNDTRUTH_TOLERANCE)
            self._T_cw = se3_inverse(T_wc)

    def __getstate__(self) -> dict[str, Any]:
        """What another process reads the same frames from, while this one keeps what `holder` holds."""
        return self.__dict__ | {"holder": None}

    @property
    def camera(self) -> Camera:
        """Intrinsics, for the size of the images. Raises CalibrationError where they are missing."""
        if self._camera is None:
            raise CalibrationError(
                f"{self.name}: nothing says which camera took the images ({self.kind}); give it with "
                "--camera fx,fy,cx,cy[,k1,k2,p1,p2,k3], a calibration file, a preset such as tum-fr1, "
                "or a guess: fov=65 (degrees), f=0.8w (image widths), exif"
            )
        return self._camera

    @camera.setter
    def camera(self, camera: Camera) -> None:
        """Another one, or one that was found out. Raises CalibrationError for another size than the images have."""
        if camera.size != self.size:
            raise CalibrationError(
                f"{self.name}: a camera for images of {camera.size}, these are {self.size}"
            )
        self._camera, self.calibrated = camera, Calibrated.GIVEN

    @property
    def known_length(self) -> int | None:
        """How many frames there are; None for a live source without an end, which has no `len`."""
        return len(self)

    def indices(self, start: int = 0) -> Iterable[int]:
        """The indices of the frames from `start` on; of a live source without an end they do not end either."""
        length = self.known_length
        return itertools.count(start) if length is None else range(start, length)

    @property
    def dropped(self) -> int:
        """Frames that a live source had and nobody had time for."""
        return 0

    @property
    def backlog(self) -> int:
        """Frames of a live source that have come and were not taken yet."""
        return 0

    @abstractmethod
    def image(self, index: int) -> Tensor:
        """(1, 1, H, W) float32 in [0, 1]. Raises FrameError where it cannot be read or has another size."""

    def color(self, index: int) -> Tensor:
        """(H, W, 3) uint8 red, green, blue; three times the same where the sequence is gray. Raises FrameError."""
        return (self.image(index)[0, 0, :, :, None] * 255.0).round().to(torch.uint8).expand(-1, -1, 3)

    @abstractmethod
    def image_name(self, index: int) -> str:
        """What the image is called in messages."""

    def mask(self, index: int) -> Tensor | None:
        """(1, 1, H, W) bool, True where features may be found in frame `index`; None: everywhere."""
        return None

    @property
    def brings_features(self) -> bool:
        """Whether its frames bring their features: then nobody looks at the images."""
        return False

    def features(self, index: int) -> Features | None:
        """Those of frame `index`, a batch of one, where the sequence brings them."""
        return None

    def timestamp(self, index: int) -> float:
        """Seconds of frame `index`; of a live source, of the frame that `image` gave."""
        return float(self.timestamps[index])

    def __len__(self) -> int:
        return int(self.timestamps.shape[0])

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`. Raises FrameError where its image cannot be read, IndexError beyond the end."""
        length = self.known_length
        if length is not None:
            if not -length <= index < length:
                raise IndexError(f"frame {index} of {length}")
            index %= length
        image = self.image(index)
        return Frame(
            index=index,
            timestamp=self.timestamp(index),
            image=image,
            name=self.image_name(index),
            T_cw_groundtruth=self.pose(index),
            mask=self.mask(index),
            features=self.features(index),
            backlog=self.backlog,
        )

    def __iter__(self) -> Iterator[Frame]:
        for index in self.indices():
            try:
                frame = self[index]
            except EndOfSequence:
                return
            yield frame

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
        return Transformed(self, indices)

    def with_camera(self, camera: Camera, calibrated: Calibrated = Calibrated.GIVEN) -> Sequence:
        """The same frames, taken with another camera. Raises CalibrationError for another size."""
        same = Transformed(self)
        same.camera, same.calibrated = camera, calibrated
        return same

    @property
    def frame_rate(self) -> float:
        """Frames per second, from the median interval; 0 for a single frame."""
        if len(self) < 2:
            return 0.0
        return 1.0 / float(self.timestamps.diff().median())

    def describe(self) -> dict[str, str]:
        """What `torchslam info` prints, label by label."""
        duration = float(self.timestamps[-1] - self.timestamps[0])
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
            "camera": self._describe_camera(),
            "ground truth": truth,
        }

    def _describe_camera(self) -> str:
        if self._camera is None:
            if self.known_length is None:
                return "missing; --camera is required"
            return "missing; estimated from the images unless --camera is given"
        numbers = " ".join(f"{number:.6g}" for number in self._camera.params.tolist())
        guessed = " (guessed)" if self.calibrated is Calibrated.GUESSED else ""
        return f"{self._camera.model} {numbers}{guessed}"


class Transformed(Sequence):
    """Another sequence's frames, some of them, perhaps changed: what a transformation leaves alone is passed on.

    indices: which frames; None: all
    camera:  for images of another size than `whole` has; `size` alone where the camera is missing
    groundtruth: another one; then `pose` is to be that of `Sequence`
    """

    def __init__(
        self,
        whole: Sequence,
        indices: range | list[int] | None = None,
        *,
        camera: Camera | None = None,
        size: tuple[int, int] | None = None,
        notes: Iterable[str] = (),
        groundtruth: Trajectory | None = None,
    ) -> None:
        super().__init__(
            whole.name,
            whole.kind,
            whole._camera if camera is None else camera,
            whole.timestamps if indices is None else whole.timestamps[list(indices)],
            whole.groundtruth if groundtruth is None else groundtruth,
            size=size or whole.size,
            guessed=whole.calibrated is Calibrated.GUESSED,
            notes=(*whole.notes, *notes),
        )
        self._whole = whole
        self._indices = indices
        self._same_pixels = camera is None and size in (None, whole.size)

    def __len__(self) -> int:
        return len(self._whole) if self._indices is None else len(self._indices)

    @property
    def known_length(self) -> int | None:
        return self._whole.known_length if self._indices is None else len(self._indices)

    @property
    def dropped(self) -> int:
        return self._whole.dropped

    @property
    def backlog(self) -> int:
        return self._whole.backlog

    def image(self, index: int) -> Tensor:
        return self._whole.image(self._at(index))

    def color(self, index: int) -> Tensor:
        return self._whole.color(self._at(index))

    def image_name(self, index: int) -> str:
        return self._whole.image_name(self._at(index))

    def mask(self, index: int) -> Tensor | None:
        return self._whole.mask(self._at(index))

    @property
    def brings_features(self) -> bool:
        return self._same_pixels and self._whole.brings_features

    def features(self, index: int) -> Features | None:
        return self._whole.features(self._at(index)) if self._same_pixels else None

    def timestamp(self, index: int) -> float:
        return self._whole.timestamp(self._at(index))

    def pose(self, index: int) -> Tensor | None:
        return self._whole.pose(self._at(index))

    def describe(self) -> dict[str, str]:
        return super().describe() if len(self.timestamps) else self._whole.describe()

    def _at(self, index: int) -> int:
        return index if self._indices is None else self._indices[index]
