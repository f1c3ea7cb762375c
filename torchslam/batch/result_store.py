"""Results that are complete or absent, each with a fingerprint of what it depends on.

In the folder of a batch, `runs/NAME/` has what a run wrote, with its record; `errors/NAME.json` has the error instead.
A fingerprint hashes the settings, the program, the files that were read and the weights.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import stat
import traceback
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import torchslam
from torchslam.data.synthetic import sequence as synthetic
from torchslam.errors import ResultsError, SequenceError, TorchslamError
from torchslam.utils.atomic_write import whole_folder, write_whole
from torchslam.utils.bounded_read import JSON_BYTES, parse_json, read_text

RUNS = "runs"
ERRORS = "errors"
RECORD = "row.json"
DONE = "done"
NO_MAP = "no map"
ERROR = "error"
OPEN = "open"
"""The status of a row: with a map, without one and why, not run because of an error, not yet run."""
Columns = dict[str, Any]


def run_or_reuse(
    output: Path,
    name: str,
    fingerprints_of: Callable[[], Columns],
    work: Callable[[Path], Columns],
    overwrite: bool = False,
) -> Columns:
    """Do the work unless its results are there; returns its columns, with `is_new` whether it was done now.

    marks:     hashes of what the results depend on, `configuration` and `input`
    work:      writes into a folder, which is given its place when all is written, and returns columns as JSON has them
    overwrite: replace results that have other marks; otherwise they are an error

    No Exception leaves it: it becomes the columns `status` and `error`, and is kept in `errors/`, with its traceback
    where nobody raised it on purpose. What failed is tried again by the next call. KeyboardInterrupt and SystemExit
    pass, and leave nothing.
    """
    known: Columns = {"name": name, "configuration": ""}
    place = output / RUNS / name
    try:
        known |= fingerprints_of()
        record = read_record(place / RECORD)
        if record is not None and all(record.get(key) == value for key, value in known.items()):
            return record | {"is_new": False}
        if record is None and place.exists():
            raise ResultsError(f"{place}: something else than results of a batch: move it away")
        if record is not None and not overwrite:
            raise ResultsError(
                f"{place}: results of another configuration, input or version of the program: "
                "--overwrite gives them up"
            )
        with whole_folder(place) as folder:
            columns = known | work(folder)
            _write(folder / RECORD, columns)
        (output / ERRORS / f"{name}.json").unlink(missing_ok=True)
        return columns | {"is_new": True}
    except Exception as error:
        is_meant = isinstance(error, TorchslamError | OSError)
        return store_failure(output, known, _describe(error), "" if is_meant else traceback.format_exc())


def store_failure(output: Path, known: Columns, words: str, trace: str = "") -> Columns:
    """The columns of what ended with an error, which are kept where that can be done."""
    columns = known | {"status": ERROR, "error": words}
    try:
        (output / ERRORS).mkdir(parents=True, exist_ok=True)
        _write(output / ERRORS / f"{known['name']}.json", columns | {"traceback": trace})
    except OSError as error:
        columns["error"] += f"; and this could not be written: {error}"
    return columns | {"is_new": True}


def read_stored(output: Path, name: str, configuration: str) -> Columns:
    """What is known of a name: the record of its results, or why there are none, of this configuration; else `open`."""
    for path in (output / RUNS / name / RECORD, output / ERRORS / f"{name}.json"):
        record = read_record(path)
        if record is not None and record.get("configuration") == configuration:
            return record
    return {"name": name, "status": OPEN}


def read_record(path: Path) -> Columns | None:
    """The columns in a file; None where there is none. Raises ResultsError for something else."""
    try:
        record = parse_json(read_text(path, JSON_BYTES, "a JSON file"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ResultsError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(record, dict) or not isinstance(record.get("status"), str):
        raise ResultsError(f"{path}: not the record of a row")
    return record


def _write(path: Path, columns: Columns) -> None:
    write_whole(path, (json.dumps(columns, indent=2) + "\n").encode())


def _describe(error: Exception) -> str:
    """One line; of an error that nobody made on purpose, its kind and where it came from."""
    if isinstance(error, TorchslamError | OSError):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:1000]} ({Path(place.filename).name}:{place.lineno})"


MAX_FILES = 1_000_000
"""Below the path of a sequence: a folder with more is none."""
DIGITS = 16
"""Hexadecimal ones of a hash that are kept: two of a billion are the same by chance with 3 %."""


def hash_json(values: Mapping[str, Any]) -> str:
    """A hash of what JSON can say."""
    text = json.dumps(values, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


@cache
def program_hash() -> str:
    """Version and files of this package: another program may find something else."""
    root = Path(torchslam.__file__).parent
    found = hashlib.sha256(torchslam.__version__.encode())
    for path in sorted(root.rglob("*")):
        if path.suffix in (".py", ".safetensors", ".js", ".css", ".html"):
            found.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return f"{torchslam.__version__}+{found.hexdigest()[:DIGITS]}"


def hash_files(paths: list[str]) -> str:
    """A hash of names, sizes and times of last change: of files, of folders with all below them, of patterns.

    What is missing counts as such. The content is not read: that would take as long as reading the images of all
    sequences at each start. Raises SequenceError for too many files, OSError for what may not be listed.
    """
    found = hashlib.sha256()
    for path in paths:
        if synthetic.matches(path):
            found.update(path.encode() + b"\0")
            continue
        for name, status in _files(path):
            found.update(f"{name}\0{status.st_size} {status.st_mtime_ns}\0".encode(errors="surrogateescape"))
        found.update(b"\1")
    return found.hexdigest()[:DIGITS]


def hash_content(path: str) -> str:
    """A hash of what is in a file, such as one of weights: another one may be given the size and time of the last.

    What is no file counts as in `hash_files`. Raises OSError for one that cannot be read.
    """
    if not os.path.isfile(path):
        return hash_files([path])
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:DIGITS]


def _files(path: str) -> Iterator[tuple[str, os.stat_result]]:
    """Files by their names below a path, sorted."""
    if not os.path.isdir(path):
        for name in [path] if os.path.exists(path) else sorted(glob.glob(path)):
            yield os.path.basename(name), os.stat(name)
        return
    count, waiting = 0, [""]
    while waiting:
        folder = waiting.pop()
        with os.scandir(os.path.join(path, folder)) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name):
                name = os.path.join(folder, entry.name)
                count += 1
                if count > MAX_FILES:
                    raise SequenceError(f"{path}: more than {MAX_FILES} files: no sequence")
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(name)
                elif os.path.exists(entry.path):  # a link may lead nowhere
                    status = entry.stat()
                    if stat.S_ISREG(status.st_mode):
                        yield name, status
