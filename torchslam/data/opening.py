"""One way into every kind of sequence: `open_sequence(path)` looks at what is there."""

from __future__ import annotations

import math
from pathlib import Path

from torchslam.data.calibration import Calibration, parse_camera, read_calibration
from torchslam.data.eth3d_tum import is_eth3d_tum, open_eth3d_tum
from torchslam.data.euroc import is_euroc, open_euroc
from torchslam.data.folder import open_folder
from torchslam.data.kitti import is_kitti, open_kitti
from torchslam.data.sequence import Sequence
from torchslam.data.synthetic import open_synthetic
from torchslam.data.video import SUFFIXES as VIDEO_SUFFIXES
from torchslam.data.video import VideoSequence
from torchslam.errors import CalibrationError, SequenceError
from torchslam.geometry.camera import Camera

RENDERED = "synthetic:"  # names of sequences that lie nowhere begin with it


def open_sequence(
    path: str | Path,
    camera: Camera | Calibration | str | Path | None = None,
    fps: float | None = None,
    limit: int | None = None,
    stride: int = 1,
) -> Sequence:
    """A sequence of whatever kind lies at `path`.

    path:   an ETH3D, TUM, KITTI or EuRoC folder, a plain folder of images, a video file, or `synthetic:room`
    camera: a Camera, `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` or a calibration file; overrides the calibration found
            at `path`, needed where there is none: plain folders, videos, TUM folders
    fps:    frames per second, for plain folders (default 30) and videos (default their own)
    limit, stride: at most `limit` frames, every `stride`-th one

    Raises SequenceError, CalibrationError or TrajectoryError that name file and line.
    """
    if fps is not None and not 0 < fps < math.inf:
        raise SequenceError(f"{path}: frames per second must be positive, not {fps:g}")
    if isinstance(camera, str | Path):
        camera = _calibration(camera)
    sequence = _open(path, camera, fps)
    if limit is None and stride == 1:
        return sequence
    return sequence.part(stop=None if limit is None else limit * stride, stride=stride)


def full_name(path: str | Path) -> str:
    """What opens the same sequence from another folder too."""
    return str(path) if str(path).startswith(RENDERED) else str(Path(path).resolve())


def _open(path: str | Path, camera: Camera | Calibration | None, fps: float | None) -> Sequence:
    if str(path).startswith(RENDERED):
        if camera is not None:
            raise CalibrationError(f"{path}: rendered sequences have a camera of their own")
        return open_synthetic(str(path))
    path = Path(path)
    if path.is_dir():
        if is_eth3d_tum(path):
            return open_eth3d_tum(path, camera)
        if is_kitti(path):
            return open_kitti(path, camera)
        if is_euroc(path):
            return open_euroc(path, camera)
        return open_folder(path, camera, fps)
    if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
        return VideoSequence(path, camera, fps)
    if path.exists():
        raise SequenceError(f"{path}: neither a folder nor a video ({', '.join(sorted(VIDEO_SUFFIXES))})")
    raise SequenceError(f"{path}: does not exist")


def _calibration(camera: str | Path) -> Calibration:
    """A camera given as text: the name of a file, or the numbers themselves."""
    return read_calibration(camera) if Path(camera).is_file() else parse_camera(str(camera))
