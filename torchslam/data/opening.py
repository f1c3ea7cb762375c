"""One way into every kind of sequence: `open_sequence(path)` looks at what is there."""

from __future__ import annotations

import math
from pathlib import Path

from torchslam.data.calibration import Calibration
from torchslam.data.camera_argument import GivenCamera, parse_calibration
from torchslam.data.formats import archive
from torchslam.data.formats.transforms import cut, resize, thin
from torchslam.data.masks import Masked
from torchslam.data.readers.registry import find_reader, live
from torchslam.data.sequence import Sequence
from torchslam.data.suggestions import why_nothing
from torchslam.data.synthetic import sequence as synthetic
from torchslam.errors import SequenceError
from torchslam.geometry.camera import Camera


def open_sequence(
    path: str | Path,
    camera: Camera | Calibration | str | Path | None = None,
    fps: float | None = None,
    limit: int | None = None,
    stride: int = 1,
    start: str | int = 0,
    stop: str | int | None = None,
    resize_to: str | None = None,
    mask: str | Path | None = None,
) -> Sequence:
    """A sequence of whatever kind lies at `path`.

    path:   a folder of ETH3D, TUM, KITTI (odometry, raw), EuRoC, 7-Scenes, TartanAir or ICL-NUIM, a folder of images or
            one with them in `images/` or `rgb/`, a pattern of files, a video, a zip of any of these, a ROS bag, the
            number of a camera, the address of a stream, or `synthetic:room`
    camera: a Camera, or what `parse_camera` takes; overrides the calibration found at `path`. Where there is none
            either, the sequence has no camera (`Sequence.calibrated`)
    fps:    frames per second: at most so many are taken; images without times are taken to be so many a second
            (otherwise 30)
    start, stop: from this frame, to before that one; numbers, or times after the first frame as `12.5s` and `1:30`
    stride, limit: of these every `stride`-th one, and at most `limit`
    resize_to: `640x480`, `640` (width) or `0.5`: the images, and the camera with them
    mask:   an image, black where no features are wanted, or a folder of them (`Masked`); of the size before resizing

    Raises SequenceError, CalibrationError or TrajectoryError that name file and line.
    """
    if fps is not None and not 0 < fps < math.inf:
        raise SequenceError(f"{path}: frames per second must be positive, not {fps:g}")
    given = parse_calibration(str(camera)) if isinstance(camera, str | Path) else camera
    try:
        sequence = _open(str(path), given, fps)
        if mask is not None:
            sequence = Masked(sequence, mask)
    except OSError as cause:  # a folder that may not be listed, a name that is too long
        raise SequenceError(f"{cause.filename or path}: cannot be read: {cause.strerror or cause}") from cause
    sequence = cut(sequence, start, stop)
    if fps is not None:
        sequence = thin(sequence, fps)
    if limit is not None or stride != 1:
        sequence = sequence.part(stop=None if limit is None else limit * stride, stride=stride)
    return sequence if resize_to is None else resize(sequence, resize_to)


def full_name(path: str | Path) -> str:
    """What opens the same sequence from another folder too."""
    path = str(path)
    return path if synthetic.matches(path) or live.matches(path) else str(Path(path).absolute())


def _open(path: str, camera: GivenCamera | None, rate: float | None) -> Sequence:
    if archive.matches(path):
        return archive.open(path, lambda folder: _open(folder, camera, rate))
    reader = find_reader(path)
    if reader is None:
        raise SequenceError(why_nothing(path))
    return reader.open(path, camera, rate)
