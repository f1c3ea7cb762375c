"""Selection of the frames in a folder by file name, without hidden files, depth images and masks."""

from __future__ import annotations

import fnmatch
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from torchslam.data.formats.image_file import SUFFIXES
from torchslam.errors import SequenceError

MAX_FILES = 1_000_000
"""Maximum number of files in a folder."""
FOLDERS = ("images", "rgb", "image", "color", "colour", "frames", "imgs", "img", "image_0", "image_2")
"""Subfolders that are searched for frames."""

# Words in the name of an image that is not a frame, separated by anything but letters.
OTHER_KINDS = {
    "depth": "depth images",
    "disp": "disparities",
    "disparity": "disparities",
    "mask": "masks",
    "masks": "masks",
    "seg": "labels",
    "semantic": "labels",
    "label": "labels",
    "labels": "labels",
    "normal": "normals",
    "normals": "normals",
    "flow": "optical flow",
}


@dataclass(frozen=True)
class Found:
    """The images of a folder.

    Attributes:
        frames: in natural order of their names
        left_out: number of files left out, by kind
    """

    frames: list[Path]
    left_out: Counter[str]

    @property
    def notes(self) -> list[str]:
        """Notes on the images that were ignored."""
        kinds = ", ".join(f"{count} {kind}" for kind, count in self.left_out.items())
        return [f"ignored: {kinds}"] if kinds else []


def natural(name: str) -> list[tuple[bool, int, str]]:
    """A sort key under which runs of digits compare as numbers."""
    parts = re.split(r"(\d+)", name.lower())
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts]


def find_frames(folder: Path) -> Found:
    """The frames among the files of a folder. Raises SequenceError where there are too many files, or two series."""
    return sort_out(_files(folder), folder)


def sort_out(files: Iterable[Path], where: Path) -> Found:
    """The frames among files. Raises SequenceError at `where` for two series that count alike: `left_7`, `right_7`."""
    frames: list[Path] = []
    left_out: Counter[str] = Counter()
    for file in files:
        kind = other_kind(file)
        if kind is None:
            frames.append(file)
        else:
            left_out[kind] += 1
    series = _series(frames)
    rivals = [name for name, numbers in series.items() if numbers & set().union(*_others(series, name))]
    if len(rivals) > 1:
        globs = " or ".join(f"'{where / name.replace('#', '*')}'" for name in sorted(rivals)[:4])
        raise SequenceError(f"{where}: several series of images that count alike; which one? Give {globs}")
    return Found(sorted(frames, key=lambda file: (natural(file.name), file.name)), left_out)


def other_kind(file: Path) -> str | None:
    """Return the kind of an image that is not a frame, in the plural; None for a frame."""
    if file.name.startswith("."):
        return "hidden files"
    words = re.split(r"[^a-z]+", file.stem.lower())
    return next((OTHER_KINDS[word] for word in words if word in OTHER_KINDS), None)


def folder_kind(folder: Path) -> str | None:
    """Return the kind of the images of a folder such as `depth/` or `masks/`, in the plural; None for frames."""
    return OTHER_KINDS.get(folder.resolve().name.lower())


def subfolder(folder: Path) -> Path | None:
    """The folder inside another one that has frames by its name and content: `images/`, `rgb/` and the like."""
    for name in FOLDERS:
        inner = folder / name
        if inner.is_dir() and any(other_kind(file) is None for file in _files(inner)):
            return inner
    return None


def _files(folder: Path) -> list[Path]:
    """The files of a folder with an image's suffix."""
    files: list[Path] = []
    for number, file in enumerate(folder.iterdir()):
        if number >= MAX_FILES:
            raise SequenceError(f"{folder}: more than {MAX_FILES} files; give a folder with the images alone")
        if file.suffix.lower() in SUFFIXES and file.is_file():
            files.append(file)
    return files


def _series(files: list[Path]) -> dict[str, set[str]]:
    """Names with `#` for each number -> the numbers that occur."""
    series: dict[str, set[str]] = {}
    for file in files:
        name = re.sub(r"\d+", "#", file.stem) + file.suffix
        if "#" in name:
            series.setdefault(name, set()).add("-".join(str(int(n)) for n in re.findall(r"\d+", file.stem)))
    return series


def _others(series: dict[str, set[str]], name: str) -> list[set[str]]:
    return [numbers for other, numbers in series.items() if other != name]


def is_pattern(path: str) -> bool:
    """Return True for a pattern of file names, such as `left-*.png`."""
    return "*" in Path(path).name and not Path(path).exists()


def match_pattern(path: str) -> Found:
    """The frames that a pattern names. Raises SequenceError where they are several series."""
    pattern, folder = Path(path).name, Path(path).parent
    files = _files(folder) if folder.is_dir() else []
    return sort_out((file for file in files if fnmatch.fnmatchcase(file.name, pattern)), folder)
