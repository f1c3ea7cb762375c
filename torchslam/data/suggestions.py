"""What was probably meant, where nothing at a path can be read."""

from __future__ import annotations

import difflib
import itertools
from collections import Counter
from pathlib import Path

from torchslam.data.formats import archive
from torchslam.data.formats.frame_names import folder_kind, other_kind, subfolder
from torchslam.data.formats.image_file import SUFFIXES
from torchslam.data.readers.registry import READERS, bag, find_reader, video

MAX_ENTRIES = 10_000
"""Entries of a folder that are looked at in search of something to propose."""
MAX_FOLDERS = 200
"""Folders inside a folder that are looked into."""
SHOWN = 6


def why_nothing(path: str) -> str:
    """One line: what is wrong with a path that no reader knows, and which one may have been meant."""
    target = Path(path)
    if target.is_dir():
        return _why_no_folder(target)
    if not target.exists():
        near = difflib.get_close_matches(target.name, _names(target.parent), n=1, cutoff=0.6)
        return f"{path}: does not exist" + _meant([target.parent / name for name in near])
    suffixes = ", ".join(sorted(video.SUFFIXES | bag.SUFFIXES | {".zip"}))
    return f"{path}: a file that is neither a video nor a recording ({suffixes})" + _meant(_around(target))


def _why_no_folder(folder: Path) -> str:
    entries = _entries(folder)
    kinds = Counter(
        other_kind(entry) or folder_kind(folder) or "images"
        for entry in entries
        if entry.is_file() and entry.suffix.lower() in SUFFIXES
    )
    inner = [entry for entry in entries if entry.is_dir() and not entry.name.startswith(".")][:MAX_FOLDERS]
    below = [entry for entry in inner if find_reader(str(entry))]
    files = [entry for entry in entries if entry.is_file() and find_reader(str(entry))]
    files += [entry for entry in entries if archive.matches(str(entry))]
    looked = "; ".join(reader.LOOKS_FOR for reader in READERS[2:])
    if kinds:
        wrong = (
            f"there are no frames, only {' and '.join(f'{count} {kind}' for kind, count in kinds.items())}"
        )
    elif below:
        wrong = f"no sequence, but {len(below)} folder{'s' if len(below) > 1 else ''} with one"
    elif not entries:
        wrong = "no images: the folder is empty"
    else:
        wrong = f"no images ({', '.join(sorted(SUFFIXES))}) and no other sequence; looked for {looked}"
    frames_beside = [] if below or files or not kinds else _around(folder)
    return f"{folder}: {wrong}" + _meant(below or files or frames_beside)


def _around(path: Path) -> list[Path]:
    """The sequence that a file, or a folder that is only a part of one, belongs to."""
    beside = subfolder(path.parent)
    if find_reader(str(path.parent)):
        return [path.parent]
    return [beside] if beside is not None else []


def _meant(proposals: list[Path]) -> str:
    """`; did you mean A?`, `; which of A, B or C?` or nothing."""
    shown = [str(proposal) for proposal in sorted(proposals)[:SHOWN]]
    if not shown:
        return ""
    if len(shown) == 1:
        return f"; did you mean {shown[0]}?"
    more = f" ... ({len(proposals)} in all)" if len(proposals) > SHOWN else ""
    return f"; which of {', '.join(shown[:-1])} or {shown[-1]}{more}?"


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(itertools.islice(folder.iterdir(), MAX_ENTRIES))
    except OSError:  # cannot be listed: then there is nothing to propose
        return []


def _names(folder: Path) -> list[str]:
    return [entry.name for entry in _entries(folder)]
