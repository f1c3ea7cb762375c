"""Image sequence: images in temporal order, their camera and, if known, the ground truth."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from enum import Enum
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from torchslam.data.calibration import UNKNOWN, Calibration, GivenCamera, size_text
from torchslam.data.trajectories import interpolate_poses
from torchslam.errors import CalibrationError, FrameError, SequenceError
from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_inverse
from torchslam.geometry.zoom import Zoom
from torchslam.types import Features, Frame, Trajectory
from torchslam.utils.console import printable, without_credentials

Need = Callable[[Iterable[float]], None]
"""Takes the times of frames as they are found, as far as they are needed."""


def exhaust(times: Iterable[float]) -> None:
    """Need all frames."""
    for _ in times:
        pass


GROUNDTRUTH_TOLERANCE = 0.02  # maximum time in seconds between an image and its ground-truth pose


class EndOfSequence(IndexError):
    """A sequence of unknown length (a live source) has ended."""


class Calibrated(Enum):
    """Source of the camera of a sequence."""

    GIVEN = "given"
    """Given by the user or the data, or estimated from the images."""
    GUESSED = "guessed"
    """Approximate: a field of view, or the focal length of EXIF."""
    MISSING = "missing"
    """Unknown, to be estimated from the images."""


class Sequence(ABC):
    """Frames by index, read on access; readers implement `image` and `image_name`.

    Attributes:
        name: name of the sequence.
        kind: description of its source.
        size: (width, height) of the images, in pixels.
        calibrated: whether the camera is given, guessed or missing.
        timestamps: (N,) float64 seconds, strictly increasing.
        groundtruth: the true trajectory at its own rate, or None.
        notes: remarks for the user on how it was read, one line each.
        camera_std: relative standard deviation of the camera's focal length, if its calibration states it.
        pixel_aspect: width to height of a pixel; the fy / fx of a camera that is not known yet.
        counted_until: where images have no times and are counted at some rate, half an interval after the last one.
        measurements: settings of the section `metric` that the dataset brings along, by name: files of its own sensors.
        as_stored: whether the orientation in the EXIF block of images is ignored, as the program did that calibrated.
        zoom: that is undone in the images; None: they are as they were taken.
        sends_pictures: whether workers that read frames ahead send small pictures of them along. For a source that is
            read in order alone, where reading a frame again takes long, and its color takes no time.
    """

    def __init__(
        self,
        name: str,
        kind: str,
        camera: GivenCamera | None,
        timestamps: Float[Tensor, " N"],
        groundtruth: Trajectory | None = None,
        *,
        size: tuple[int, int] | None = None,
        guessed: bool = False,
        notes: Iterable[str] = (),
        pixel_aspect: float = 1.0,
    ) -> None:
        """Take the size of the images (required without a Camera); `guessed`: the Camera is approximate.

        Raises CalibrationError for a camera of another size.
        """
        self.name = printable(without_credentials(name))
        self.kind = printable(kind)
        known = size or (None if camera is None else camera.size)
        if known is None:
            raise ValueError("a sequence without a camera needs the size of its images")
        self.size = known
        self.pixel_aspect = pixel_aspect
        self.camera_std: float | None = None
        if isinstance(camera, Calibration):
            guessed, self.camera_std = camera.guessed, camera.std
            camera = camera.camera(known, pixel_aspect)
        self._camera = None if camera is None else self._checked(camera)
        self.calibrated = Calibrated.GUESSED if guessed else Calibrated.GIVEN
        if camera is None:
            self.calibrated = Calibrated.MISSING
        self.timestamps = timestamps
        self.groundtruth = groundtruth
        self.notes = tuple(map(printable, notes))
        self.as_stored = False
        self.zoom: Zoom | None = None
        self.sends_pictures = False
        self.measurements: Mapping[str, str] = {}
        self.counted_until: float | None = None
        self.holder: object = None  # of what must not go before the sequence does: unpacked files
        self._T_cw: Tensor | None = None
        self._has_pose = torch.zeros(len(timestamps), dtype=torch.bool, device="cpu")
        if groundtruth is not None:
            T_wc, self._has_pose = interpolate_poses(groundtruth, timestamps, GROUNDTRUTH_TOLERANCE)
            self._T_cw = se3_inverse(T_wc)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process, which reads the same frames; this one keeps `holder`."""
        return self.__dict__ | {"holder": None}

    @property
    def camera(self) -> Camera:
        """Intrinsics, for the size of the images. Raises CalibrationError where they are missing."""
        if self._camera is None:
            raise CalibrationError(
                f"{self.name}: the camera is unknown ({self.kind}); give it with "
                "--camera fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]], a calibration file, a preset such as tum-fr1, "
                "or a guess: fov=65 (degrees), f=0.8w (image widths), exif"
            )
        return self._camera

    @camera.setter
    def camera(self, camera: Camera) -> None:
        """Another camera, or an estimated one. Raises CalibrationError for another size than the images have."""
        self._camera, self.calibrated, self.camera_std = self._checked(camera), Calibrated.GIVEN, None

    def _check_size(self, shape: tuple[int, ...], where: str) -> None:
        """Raise FrameError for an image of the shape (H, W, ...) that has another size than the others."""
        if shape[1::-1] != self.size:
            sizes = f"{size_text((shape[1], shape[0]))}, the others are {size_text(self.size)}"
            raise FrameError(f"{where} is {sizes}")

    def _checked(self, camera: Camera) -> Camera:
        if camera.size != self.size:
            raise CalibrationError(
                f"{self.name}: the camera is for images of {size_text(camera.size)}, these are {size_text(self.size)}"
            )
        return camera

    @property
    def known_length(self) -> int | None:
        """Number of frames; None for a live source, which has no end and no `len`."""
        return len(self)

    @property
    def is_live(self) -> bool:
        """Whether each frame is available only once, when it arrives, also where a limit is set."""
        return not len(self.timestamps)

    def indices(self, start: int = 0) -> Iterable[int]:
        """Return the frame indices from `start` on; endless for a live source."""
        length = self.known_length
        return itertools.count(start) if length is None else range(start, length)

    @property
    def dropped(self) -> int:
        """Number of frames of a live source that were dropped because processing was too slow."""
        return 0

    @property
    def backlog(self) -> int:
        """Frames of a live source that have come and were not taken yet."""
        return 0

    @abstractmethod
    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        """Return the gray image in [0, 1]. Raises FrameError if unreadable or of another size."""

    def color(self, index: int) -> UInt8[Tensor, "H W 3"]:
        """Return the RGB image; three equal channels for a gray sequence. Raises FrameError."""
        return (self.image(index)[0, 0, :, :, None] * 255.0).round().to(torch.uint8).expand(-1, -1, 3)

    @abstractmethod
    def image_name(self, index: int) -> str:
        """Return the name of an image, for messages."""

    def file_name(self, index: int) -> str:
        """Return the file of a frame below the folder of all; empty if frames are no files but known by their times."""
        return ""

    def is_turned(self, index: int) -> bool:
        """Return whether an image has another orientation than its pixels in the file. Raises FrameError."""
        return False

    def mask(self, index: int) -> Bool[Tensor, "1 1 H W"] | None:
        """Return the mask of a frame, True where features are allowed; None: everywhere."""
        return None

    @property
    def brings_features(self) -> bool:
        """True if the frames come with features; the images are not used then."""
        return False

    def features(self, index: int) -> Features | None:
        """Return the features of a frame as a batch of one, if the sequence provides them."""
        return None

    def timestamp(self, index: int) -> float:
        """Return the time of a frame in seconds; for a live source, of the last frame from `image`."""
        return float(self.timestamps[index])

    def __len__(self) -> int:
        return int(self.timestamps.shape[0])

    def __getitem__(self, index: int) -> Frame:
        """Return a frame. Raises FrameError if its image cannot be read, IndexError beyond the end."""
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

    def pose(self, index: int) -> Float[Tensor, "4 4"] | None:
        """Return the true T_cw of a frame without reading its image; None if unknown."""
        if self._T_cw is None or not self._has_pose[index]:
            return None
        return self._T_cw[index]

    def part(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Sequence:
        """Return every `stride`-th frame of [start, stop) as a sequence. Raises SequenceError if that is empty."""
        if stride < 1:
            raise SequenceError(f"{self.name}: the stride must be positive, not {stride}")
        indices = range(len(self))[start:stop:stride]
        if not indices:
            raise SequenceError(f"{self.name}: no frames left of {len(self)}")
        return Transformed(self, indices)

    def with_camera(
        self, camera: Camera, calibrated: Calibrated = Calibrated.GIVEN, std: float | None = None
    ) -> Sequence:
        """Return the sequence with another camera; `std`: relative standard deviation of its focal length, if known.

        Raises CalibrationError for another image size.
        """
        same = Transformed(self)
        same.camera, same.calibrated, same.camera_std = camera, calibrated, std
        return same

    def with_guess(self) -> Sequence:
        """Return the sequence with a guess of its camera if that is missing."""
        if self.calibrated is not Calibrated.MISSING:
            return self
        return self.with_camera(UNKNOWN.camera(self.size, self.pixel_aspect), Calibrated.GUESSED)

    def unzoomed(self, zoom: Zoom | None) -> Sequence:
        """Return the sequence with a zoom undone in its images; None: as they were taken."""
        return self if zoom is None else Unzoomed(self, zoom)

    @property
    def frame_rate(self) -> float:
        """Frames per second by the median interval; 0 for a single frame."""
        if len(self) < 2:
            return 0.0
        return 1.0 / float(self.timestamps.diff().median())

    def describe(self) -> dict[str, str]:
        """Return the rows that `torchslam info` prints."""
        about = {"name": self.name, "kind": self.kind}
        aspect = aspect_text(self.pixel_aspect)
        of_pixels = "" if aspect == "1:1" else f", pixels of {aspect}, wide to high"
        seen = {"size": f"{size_text(self.size)}{of_pixels}", "camera": self._describe_camera()}
        if self.is_live:
            return about | {"frames": "as they come"} | seen
        duration = float(self.timestamps[-1] - self.timestamps[0])
        truth = "none"
        if self.groundtruth is not None:
            length = float(self.groundtruth.positions_w.diff(dim=0).norm(dim=-1).sum())
            with_pose = int(self._has_pose.sum())
            truth = f"{len(self.groundtruth)} poses, {length:.2f} m, for {with_pose} of {len(self)} frames"
        rate = f"{self.frame_rate:.2f} Hz over {duration:.2f} s"
        frames = {"frames": str(len(self)), "size": seen["size"], "rate": rate}
        return about | frames | seen | {"ground truth": truth}

    def _describe_camera(self) -> str:
        if self._camera is None:
            if self.known_length is None:
                return "missing; --camera is required"
            return "missing; estimated from the images unless --camera is given"
        numbers = " ".join(f"{number:.6g}" for number in self._camera.params.tolist())
        guessed = " (guessed)" if self.calibrated is Calibrated.GUESSED else ""
        return f"{self._camera.model} {numbers}{guessed}"


class Frames(Protocol):
    """The frames of a run, each read once and in order: a sequence, or one that workers read ahead."""

    def __getitem__(self, index: int) -> Frame:
        """The frame of an index."""


class Transformed(Sequence):
    """Base class of transformed sequences: passes everything on that a subclass does not override.

    Args:
        indices: the selected frames of the whole; None: all.
        camera, size: for images of another size; `size` alone if there is no camera.
        notes: additional notes.
        groundtruth: replacement of the ground truth; subclasses then override `pose`.
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
        width, height = size or whole.size
        super().__init__(
            whole.name,
            whole.kind,
            whole._camera if camera is None else camera,
            whole.timestamps if indices is None else whole.timestamps[list(indices)],
            whole.groundtruth if groundtruth is None else groundtruth,
            size=(width, height),
            guessed=whole.calibrated is Calibrated.GUESSED,
            notes=(*whole.notes, *notes),
            pixel_aspect=whole.pixel_aspect * (whole.size[0] / width) / (whole.size[1] / height),
        )
        self.camera_std, self.as_stored = whole.camera_std, whole.as_stored
        self.counted_until, self.measurements = whole.counted_until, whole.measurements
        self.zoom, self.sends_pictures = whole.zoom, whole.sends_pictures
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

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        return self._whole.image(self._at(index))

    def color(self, index: int) -> UInt8[Tensor, "H W 3"]:
        return self._whole.color(self._at(index))

    def image_name(self, index: int) -> str:
        return self._whole.image_name(self._at(index))

    def file_name(self, index: int) -> str:
        return self._whole.file_name(self._at(index))

    def is_turned(self, index: int) -> bool:
        return self._whole.is_turned(self._at(index))

    def mask(self, index: int) -> Bool[Tensor, "1 1 H W"] | None:
        return self._whole.mask(self._at(index))

    @property
    def brings_features(self) -> bool:
        return self._same_pixels and self._whole.brings_features

    def features(self, index: int) -> Features | None:
        return self._whole.features(self._at(index)) if self._same_pixels else None

    def timestamp(self, index: int) -> float:
        return self._whole.timestamp(self._at(index))

    def pose(self, index: int) -> Float[Tensor, "4 4"] | None:
        return self._whole.pose(self._at(index))

    def _at(self, index: int) -> int:
        return index if self._indices is None else self._indices[index]


def aspect_text(aspect: float) -> str:
    """`16:15`, for pixels that are a little wider than high."""
    ratio = Fraction(aspect).limit_denominator(100)
    return f"{ratio.numerator}:{ratio.denominator}"


class Reader(NamedTuple):
    """A kind of sequence: how it is recognized and opened.

    Attributes:
        looks_for: the files by which it is recognized, for messages.
        matches: whether a path is of this kind.
        open: opens a path; the arguments are the path, the camera that overrides its own, and the frame rate for kinds
            without timestamps. Raises SequenceError, CalibrationError or TrajectoryError, naming file and line.
        takes_need: whether `open` takes a fourth argument, a `Need`, since the times take long to find; later frames
            are left out.
    """

    looks_for: str
    matches: Callable[[str], bool]
    open: Callable[..., Sequence]
    takes_need: bool = False


class Unzoomed(Transformed):
    """Sequence whose images are those of a camera with one focal length, see `geometry.zoom`.

    Images of a longer focal length become smaller, with a margin that is masked; of those of a shorter one the margin
    is lost.
    """

    def __init__(self, whole: Sequence, zoom: Zoom) -> None:
        super().__init__(whole)
        self.zoom = zoom

    def unzoomed(self, zoom: Zoom | None) -> Sequence:
        return self._whole.unzoomed(zoom)

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        image = super().image(index)
        return self._undone(image[0, 0], index)[None, None]

    def color(self, index: int) -> UInt8[Tensor, "H W 3"]:
        return self._undone(super().color(index), index)

    def mask(self, index: int) -> Bool[Tensor, "1 1 H W"] | None:
        mask, (width, height) = super().mask(index), self.size
        whole = (
            torch.ones(height, width, dtype=torch.uint8, device="cpu") if mask is None else mask[0, 0].byte()
        )
        return self._undone(whole, index, is_mask=True)[None, None] > 0

    def features(self, index: int) -> Features | None:
        features = super().features(index)
        if features is None:
            return None
        assert self.zoom is not None
        frame = torch.tensor([index], device=features.keypoints.device)
        return replace(features, keypoints=self.zoom.undone(features.keypoints, frame, self.camera))

    def _undone(self, image: Tensor, index: int, is_mask: bool = False) -> Tensor:
        assert self.zoom is not None
        ratio = float(self.zoom.at(torch.tensor([index], device="cpu"))[0])
        return unzoomed_image(image, ratio, self.camera, is_mask)


def unzoomed_image(
    image: Shaped[Tensor, "H W *c"], ratio: float, camera: Camera, is_mask: bool = False
) -> Tensor:
    """An image as the camera would have taken it with its own focal length, `ratio` times shorter.

    A margin has the colors of its edge; in a mask it is 0.
    """
    if ratio == 1.0:
        return image
    cx, cy = (float(number) for number in camera.params[2:4])
    to_image = np.array([[ratio, 0, cx * (1 - ratio)], [0, ratio, cy * (1 - ratio)]])
    interpolation = cv2.INTER_NEAREST if is_mask else cv2.INTER_CUBIC if ratio < 1 else cv2.INTER_LINEAR
    border = cv2.BORDER_CONSTANT if is_mask else cv2.BORDER_REPLICATE
    flags = interpolation | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(image.contiguous().numpy(), to_image, camera.size, flags=flags, borderMode=border)
    found = torch.from_numpy(warped)
    return found.clamp(0.0, 1.0) if found.is_floating_point() else found
