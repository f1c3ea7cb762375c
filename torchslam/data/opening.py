"""`open_sequence`: one entry point for folders, files, archives and streams, with suggestions for wrong paths."""

from __future__ import annotations

import difflib
import itertools
import math
import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from torchslam.data.calibration import GivenCamera
from torchslam.data.download import unpack
from torchslam.data.formats.calibration_files import parse_calibration
from torchslam.data.formats.frame_names import FOLDERS, folder_kind, is_pattern, other_kind, subfolder
from torchslam.data.formats.image_file import FOREIGN, SUFFIXES
from torchslam.data.readers import bag, video
from torchslam.data.readers.bag import BAG
from torchslam.data.readers.datasets import EUROC, ICL_NUIM, SEVEN_SCENES, TARTANAIR, TUM
from torchslam.data.readers.image_sequence import FOLDER
from torchslam.data.readers.kitti import KITTI, KITTI_RAW
from torchslam.data.readers.live import LIVE, is_address, is_live
from torchslam.data.readers.video import VIDEO
from torchslam.data.sequence import Need, Reader, Sequence, exhaust
from torchslam.data.synthetic.sequence import SYNTHETIC, is_synthetic
from torchslam.data.transforms import Masked, Selection, resize
from torchslam.errors import DownloadError, SequenceError, TorchslamError
from torchslam.utils.console import without_credentials

# The first match is used: readers of specific layouts precede those of plain images.
READERS = (
    *(SYNTHETIC, LIVE, VIDEO, BAG),
    *(ICL_NUIM, TUM, KITTI, KITTI_RAW, EUROC, SEVEN_SCENES, TARTANAIR),
    FOLDER,
)


def open_sequence(
    path: str | Path,
    camera: GivenCamera | str | Path | None = None,
    fps: float | None = None,
    limit: int | None = None,
    stride: int = 1,
    start: str | int = 0,
    stop: str | int | None = None,
    resize_to: str | None = None,
    mask: str | Path | None = None,
) -> Sequence:
    """Open a sequence of any supported kind.

    Args:
        path: a folder of ETH3D, TUM, KITTI (odometry, raw), EuRoC, 7-Scenes, TartanAir or ICL-NUIM, a folder of images
            (also in `images/` or `rgb/`), a file pattern, a video, a zip of any of these, a ROS bag, the number of a
            camera, the address of a stream, or `synthetic:room`.
        camera: a Camera, or text for `parse_camera`; overrides the calibration found at `path`. If there is neither,
            the sequence has no camera (`Sequence.calibrated`).
        fps: maximum number of frames per second; also the frame rate of images without timestamps (default: 30).
        limit: maximum number of frames.
        stride: use every `stride`-th frame.
        start, stop: first frame and end of the range, as numbers or times such as `12.5s` and `1:30`.
        resize_to: new size `640x480`, `640` (width) or `0.5`; the camera is adapted.
        mask: mask image, black where no features are wanted, or a folder of masks (`Masked`), in the original size.

    Raises:
        SequenceError, CalibrationError, TrajectoryError: naming file and line.
    """
    if fps is not None and not 0 < fps < math.inf:
        raise SequenceError(f"{path}: frames per second must be positive, not {fps:g}")
    selection = Selection(start, stop, fps, limit, stride)
    given = parse_calibration(str(camera)) if isinstance(camera, str | Path) else camera
    try:
        # A folder of masks may be matched by the number of all frames.
        is_whole = mask is not None and Path(mask).is_dir()
        need: Need = exhaust if is_whole else lambda times: exhaust(selection.indices(times))
        sequence = _open(str(path), given, fps, need)
        if mask is not None:
            sequence = Masked(sequence, mask)
    except OSError as cause:  # an unreadable folder, or a name that is too long
        raise SequenceError(f"{cause.filename or path}: cannot be read: {cause.strerror or cause}") from cause
    sequence = selection.of(sequence)
    return sequence if resize_to is None else resize(sequence, resize_to)


def full_name(path: str | Path) -> str:
    """Return a path that opens the sequence from any working directory; an address without its credentials."""
    path = str(path)
    if is_address(path):
        return without_credentials(path)
    return path if is_synthetic(path) or is_live(path) else str(Path(path).absolute())


def find_reader(path: str) -> Reader | None:
    """Return the reader for a path; None if there is none."""
    return next((reader for reader in READERS if reader.matches(path)), None)


def _open(path: str, camera: GivenCamera | None, rate: float | None, needed: Need) -> Sequence:
    if _is_archive(path):
        return _open_archive(path, lambda folder: _open(folder, camera, rate, needed))
    reader = find_reader(path)
    if reader is None:
        raise SequenceError(_not_found_message(path))
    return reader.open(path, camera, rate, *((needed,) if reader.takes_need else ()))


def _is_archive(path: str) -> bool:
    return Path(path).suffix.lower() == ".zip" and Path(path).is_file()


def _open_archive(path: str, open_folder: Callable[[str], Sequence]) -> Sequence:
    """Open the sequence in an archive with `open_folder`.

    Raises SequenceError for an archive that is damaged, unsafe or too large for the disk.
    """
    archive = Path(path)
    holder = tempfile.TemporaryDirectory(prefix="torchslam-")
    folder = Path(holder.name) / archive.stem
    try:
        unpack(archive, folder)
        sequence = open_folder(_only_sequence(archive, folder))
        _check_inside(sequence, folder)
    except BaseException as error:
        holder.cleanup()
        if isinstance(error, DownloadError):
            raise SequenceError(str(error)) from error
        if isinstance(error, TorchslamError):
            message = str(error).replace(str(folder), path)
            hint = "; unpack it first" if f"'{path}/" in message else ""  # a part of it cannot be opened
            raise type(error)(message + hint) from error
        raise
    sequence.holder = holder  # the files are deleted with the sequence
    return sequence


def _check_inside(sequence: Sequence, folder: Path) -> None:
    """Raise SequenceError for an image outside of the unpacked archive, which a list in it can name."""
    start = os.path.join(os.path.abspath(folder), "")
    for index in range(len(sequence)):
        if not os.path.abspath(sequence.image_name(index)).startswith(start):
            raise SequenceError(f"{folder}: image {index} is outside of the archive")


def _only_sequence(archive: Path, folder: Path) -> str:
    """Return the folder of an unpacked archive, or the one file or folder in it that is a sequence.

    Raises SequenceError for several of them: what is in an archive cannot be named.
    """
    if find_reader(str(folder)):
        return str(folder)
    inside = [entry for entry in _entries(folder) if not entry.name.startswith((".", "__MACOSX"))]
    found = [entry for entry in inside if find_reader(str(entry))]
    if len(found) == 1:
        return str(found[0])
    packed = [entry for entry in inside if entry.suffix.lower() == ".zip"]
    names = ", ".join([entry.name for entry in found or packed][:SHOWN])
    if found:
        more = ", ..." * (len(found) > SHOWN)
        what = f"holds {len(found)} sequences ({names}{more}); unpack it and open one of them"
    elif packed:
        what = f"holds archives ({names}); unpack it and open one"
    else:
        what = f"no images ({', '.join(sorted(SUFFIXES))}), no video and no other sequence in it"
    raise SequenceError(f"{archive}: {what}")


SHOWN = 6  # names in a message, which stays short


def _not_found_message(path: str) -> str:
    """Return a one-line message for a path that no reader accepts, with a suggestion."""
    target = Path(path)
    if target.is_dir():
        return _why_no_folder(target)
    if is_address(path):
        return f"{without_credentials(path)}: a file on the web and no stream: download it, and give the file"
    counted = target.with_name(re.sub(r"%\d*d", "*", target.name))
    if counted != target and find_reader(str(counted)):
        return f"{path}: does not exist; did you mean '{counted}'? In quotes, * stands for any number"
    foreign = target.suffix.lower() in FOREIGN and (other_kind(target) or "hidden files")
    if foreign and (target.exists() or is_pattern(path)):
        return f"{path}: {foreign}"
    if not target.exists():
        names = [each.name for each in _entries(target.parent)]
        near = difflib.get_close_matches(target.name, names, n=1, cutoff=0.6)
        return f"{path}: does not exist" + _meant([target.parent / name for name in near])
    suffixes = ", ".join(sorted(video.SUFFIXES | bag.SUFFIXES | {".zip"}))
    return f"{path}: a file that is neither a video nor a recording ({suffixes})" + _meant(_around(target))


def _why_no_folder(folder: Path) -> str:
    entries = _entries(folder)
    files = [entry for entry in entries if entry.is_file()]
    folders = [entry for entry in entries if entry.is_dir() and not entry.name.startswith(".")][:200]
    images = [file for file in files if file.suffix.lower() in SUFFIXES | FOREIGN]
    below = [entry for entry in folders if find_reader(str(entry))]
    readable = [file for file in files if find_reader(str(file)) or _is_archive(str(file))]
    kinds = Counter(other_kind(file) or folder_kind(folder) or "images" for file in images)
    inner = [file for name in FOLDERS for file in _entries(folder / name) if file.suffix.lower() in FOREIGN]
    kinds = kinds or Counter(f"{other_kind(file)} below" for file in inner)
    if kinds:
        counts = " and ".join(f"{count} {kind}" for kind, count in kinds.items())
        wrong = f"there are no frames, only {counts}"
    elif below:
        wrong = f"no sequence, but {len(below)} folder{'s' if len(below) > 1 else ''} with one"
    elif not entries:
        wrong = "no images: the folder is empty"
    else:
        looked = "; ".join(reader.looks_for for reader in READERS[2:])
        wrong = f"no images ({', '.join(sorted(SUFFIXES))}) and no other sequence; looked for {looked}"
    return f"{folder}: {wrong}" + _meant(below or readable or (_around(folder) if kinds else []))


def _around(path: Path) -> list[Path]:
    """Return the sequence to which a file or a part of a dataset belongs."""
    if find_reader(str(path.parent)):
        return [path.parent]
    sibling = subfolder(path.parent)
    return [] if sibling is None else [sibling]


def _meant(proposals: list[Path]) -> str:
    """Return `; did you mean A?`, `; which of A, B or C?` or an empty string."""
    shown = [str(proposal) for proposal in sorted(proposals)[:SHOWN]]
    if len(shown) < 2:
        return f"; did you mean {shown[0]}?" if shown else ""
    more = f" ... ({len(proposals)} in all)" if len(proposals) > SHOWN else ""
    return f"; which of {', '.join(shown[:-1])} or {shown[-1]}{more}?"


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(itertools.islice(folder.iterdir(), 10_000))
    except OSError:  # an unreadable folder gives no suggestions
        return []
