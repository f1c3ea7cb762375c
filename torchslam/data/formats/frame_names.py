"""Selection of the frames in a folder by file name, without hidden files, depth images and masks."""

from __future__ import annotations

import fnmatch
import itertools
import re
import statistics
from collections import Counter
from collections.abc import Iterable, Set
from functools import partial
from pathlib import Path
from typing import NamedTuple

from torchslam.data.formats.image_file import FOREIGN, SUFFIXES
from torchslam.data.text_file import UNIX_UNITS
from torchslam.errors import SequenceError

MAX_FILES = 1_000_000  # maximum number of files in a folder
FOLDERS = ("images", "rgb", "image", "color", "colour", "frames", "imgs", "img", "image_0", "image_2")
"""Subfolders that are searched for frames."""

# Words in the name of an image that is not a frame, separated by anything but letters.
OTHER_KINDS = {
    "depth": "depth images",
    "flow": "optical flow",
    **dict.fromkeys(("disp", "disparity"), "disparities"),
    **dict.fromkeys(("mask", "masks"), "masks"),
    **dict.fromkeys(("seg", "semantic", "label", "labels"), "labels"),
    **dict.fromkeys(("normal", "normals"), "normals"),
}


class Found(NamedTuple):
    """The frames of a folder, in natural order of their names, and the number of files left out, by kind."""

    frames: list[Path]
    left_out: Counter[str]

    @property
    def notes(self) -> list[str]:
        """Notes on the images that were ignored."""
        kinds = ", ".join(f"{count} {kind}" for kind, count in self.left_out.items())
        return [f"ignored: {kinds}"] if kinds else []


CAMERA_WORDS = frozenset(
    ("cam", "camera", "image", "img", "sensor", "lens", "eye", "view", "rgb", "color", "imager", "stereo")
)
"""Words before the number of a camera."""
MAX_CAMERAS = 8  # of a rig whose images are in one folder
LEAST_ALIKE = (
    241  # images that count alike are of cameras: more than frames in a second or seconds in a minute
)
NUMBER = re.compile(r"((?<!\d)(?<!\d\.)\d+\.\d+(?!\.?\d)|\d+)")
"""A run of digits, or two with a dot between them; more dots separate parts of a version or a date."""
UNIX_DIGITS = range(9, 11)  # digits of the seconds since 1970, from 1973 to 2286
SHORTEST = 1e-3  # seconds between images, below which decimals in names count something else


def in_order(files: Iterable[Path]) -> list[Path]:
    """Sort files by name, such that runs of digits compare as numbers and a dot between digits starts a fraction."""
    files = list(files)
    number = NUMBER if _has_fractions(files) else re.compile(r"(\d+)")

    def key(file: Path) -> tuple[list[tuple[bool, int, str]], str]:
        parts = []
        for place, part in enumerate(number.split(file.name.lower())):
            whole, _, fraction = part.partition(".")
            parts.append((True, int(whole), fraction) if place % 2 else (False, 0, part))
        return parts, file.name

    return sorted(files, key=key)


def _has_fractions(files: list[Path]) -> bool:
    """Return whether the digits after a dot are fractions, and do not count (1.9, 1.10).

    Fractions have one length, or no zeros at their end. Raises SequenceError for times since 1970 that seem to count,
    as of a program that leaves zeros out after the dot.
    """
    numbers = [
        number.partition(".") for file in files for number in NUMBER.findall(file.stem) if "." in number
    ]
    by_length = {len(fraction): f"{whole}.{fraction}" for whole, _, fraction in numbers}
    if len(by_length) < 2:
        return True
    fractions = [fraction for _, _, fraction in numbers if len(fraction) > 1]
    has_ends = any(fraction.endswith("0") for fraction in fractions)
    if not any(len(whole) in UNIX_DIGITS for whole, _, _ in numbers):
        counts = sorted(int(fraction) for _, _, fraction in numbers)
        steps = {after - before for before, after in itertools.pairwise(counts)}
        return not has_ends and (len(counts) < 3 or len(steps) > 1)
    if any(fraction.startswith("0") for fraction in fractions):
        is_counted = False
    else:
        parts = 10 ** max(by_length)
        counted = [int(whole) + int(fraction) / parts for whole, _, fraction in numbers]
        decimal = [float(f"{whole}.{fraction}") for whole, _, fraction in numbers]
        is_long = max(by_length) > 7  # the shortest text that is a float has at most so many
        is_counted = has_ends or is_long or _irregularity(counted) < _irregularity(decimal)
    if is_counted:
        raise SequenceError(
            f"{files[0].parent}: names with {by_length[min(by_length)]} and with {by_length[max(by_length)]}: zeros "
            "after the dot seem to be missing in some; write the times with one number of digits"
        )
    return True


def _irregularity(times: list[float]) -> float:
    return statistics.pstdev(after - before for before, after in itertools.pairwise(sorted(times)))


def times_in_names(frames: list[Path]) -> list[float] | None:
    """Return the times that images, in order, are named by, seconds; None where names are something else.

    Times are decimals (`0.5.png`), in names with other parts those since 1970 alone (`left_1305031102.0338.png`), or
    they count milli-, micro- or nanoseconds since then.
    """
    names = [NUMBER.split(file.stem) for file in frames]
    columns = list(zip(*names, strict=False))
    if len(frames) < 2 or len(set(map(len, names))) > 1 or any(len(set(texts)) > 1 for texts in columns[::2]):
        return None
    is_bare = columns[::2] == [("",) * len(frames)] * 2
    found = [times for times in map(partial(_times, is_bare), columns[1::2]) if times is not None]
    return found[0] if len(found) == 1 and _has_fractions(frames) else None


def _times(is_bare: bool, numbers: tuple[str, ...]) -> list[float] | None:
    """The numbers in one place of the names as times; None if they are none."""
    digits = {len(number.partition(".")[0]) for number in numbers}
    if any("." in number for number in numbers):
        times = [float(number) for number in numbers] if is_bare or digits <= set(UNIX_DIGITS) else []
    else:
        unit = UNIX_UNITS.get(digits.pop()) if len(digits) == 1 else None
        times = [] if unit is None else [int(number) / unit for number in numbers]
    intervals = [after - before for before, after in itertools.pairwise(times)]
    return times if intervals and statistics.median(intervals) >= SHORTEST else None


def find_frames(folder: Path, pattern: str = "*") -> Found:
    """The frames among the files of a folder whose names fit a pattern.

    Raises SequenceError where there are too many files, or two series that count alike: `left_7`, `right_7`.
    """
    frames: list[Path] = []
    left_out: Counter[str] = Counter()
    for file in files_in(folder, SUFFIXES | FOREIGN):
        kind = other_kind(file)
        if not fnmatch.fnmatchcase(file.name, pattern):
            continue
        if kind is None:
            frames.append(file)
        else:
            left_out[kind] += 1
    series: dict[str, list[tuple[str, ...]]] = {}  # of names with `*` for each number: the numbers
    for file in frames:
        if numbers := re.findall(r"\d+", file.stem):
            series.setdefault(re.sub(r"\d+", "*", file.stem) + file.suffix, []).append(tuple(numbers))
    counted = {name: {tuple(map(int, each)) for each in numbers} for name, numbers in series.items()}
    shared = Counter(number for numbers in counted.values() for number in numbers)
    rivals = sorted(
        name for name, numbers in counted.items() if any(shared[number] > 1 for number in numbers)
    )
    rivals = rivals if len(rivals) > 1 else [each for item in series.items() for each in _cameras(*item)]
    if rivals:
        globs = " or ".join(f"'{folder / name}'" for name in rivals[:4])
        raise SequenceError(f"{folder}: several series of images that count alike; which one? Give {globs}")
    return Found(in_order(frames), left_out)


def _cameras(name: str, numbers: list[tuple[str, ...]]) -> list[str]:
    """Return the patterns of the cameras that one number of the names counts, none where no number does.

    They are few, and their images count alike: many of them, or any of them after a word for a camera.
    """
    columns, parts = list(zip(*numbers, strict=True)), name.split("*")
    varying = sum(len(set(texts)) > 1 for texts in columns)
    for place, texts in enumerate(columns):
        images: dict[str, set[tuple[int, ...]]] = {}
        for text, each in zip(texts, numbers, strict=True):
            images.setdefault(text, set()).add(tuple(map(int, each[:place] + each[place + 1 :])))
        if not 1 < len(images) <= MAX_CAMERAS or varying == 1:
            continue
        word = re.search(r"([a-z]*)[^a-z]*$", parts[place].lower())
        pairs = list(itertools.combinations(images.values(), 2))
        if word is not None and word[1] in CAMERA_WORDS:  # shutters of two clocks give no equal times
            are_alike = all(max(min(a), min(b)) <= min(max(a), max(b)) for a, b in pairs)
        else:
            are_alike = varying == 2 and all(len(a & b) >= LEAST_ALIKE for a, b in pairs)
        if are_alike:
            ends = "*".join(parts[: place + 1]), "*".join(parts[place + 1 :])
            return [text.join(ends) for text in sorted(images)]
    return []


def other_kind(file: Path) -> str | None:
    """Return the kind of an image that is not a frame, in the plural; None for a frame."""
    if file.name.startswith("."):
        return "hidden files"
    if file.suffix.lower() in FOREIGN:
        return f"{file.suffix[1:].upper()} images, which are not read (convert them to JPEG or PNG)"
    words = re.split(r"[^a-z]+", file.stem.lower())
    return next((OTHER_KINDS[word] for word in words if word in OTHER_KINDS), None)


def folder_kind(folder: Path) -> str | None:
    """Return the kind of the images of a folder such as `depth/` or `masks/`, in the plural; None for frames."""
    return OTHER_KINDS.get(folder.resolve().name.lower())


def subfolder(folder: Path) -> Path | None:
    """The folder inside another one that has frames by its name and content: `images/`, `rgb/` and the like."""
    for name in FOLDERS:
        inner = folder / name
        if inner.is_dir() and any(other_kind(file) is None for file in files_in(inner, SUFFIXES | FOREIGN)):
            return inner
    return None


def files_in(folder: Path, suffixes: Set[str]) -> list[Path]:
    """The files of a folder with one of some suffixes. Raises SequenceError for more than MAX_FILES entries."""
    entries = list(itertools.islice(folder.iterdir(), MAX_FILES + 1))
    if len(entries) > MAX_FILES:
        raise SequenceError(f"{folder}: more than {MAX_FILES} files; give a folder with the images alone")
    return [file for file in entries if file.suffix.lower() in suffixes and file.is_file()]


def is_pattern(path: str) -> bool:
    """Return True for a pattern of file names, such as `left-*.png`."""
    return "*" in Path(path).name and not Path(path).exists()


def match_pattern(path: str) -> Found:
    """The frames that a pattern names, see `find_frames`."""
    folder = Path(path).parent
    return find_frames(folder, Path(path).name) if folder.is_dir() else Found([], Counter())
