"""Results that are complete or absent, each with a fingerprint of what it depends on.

In the folder of a batch, `runs/NAME/` has what a run wrote, with its record; `errors/NAME.json` has the error instead.
A fingerprint hashes the settings, the program, and the files that were read.
"""

from __future__ import annotations

import glob
import json
import os
import traceback
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import torchslam
from torchslam.data.formats.frame_names import MAX_FILES
from torchslam.data.synthetic import is_synthetic
from torchslam.data.text_file import read_object
from torchslam.errors import ResultsError, SequenceError, TorchslamError
from torchslam.utils.console import printable, without_credentials
from torchslam.utils.files import fingerprint, whole_folder, write_whole

RUNS = "runs"
ERRORS = "errors"
RECORD = "row.json"
DONE = "done"
NO_MAP = "no map"
ERROR = "error"
OPEN = "open"
"""The status of a row: with a map, without a map, failed with an error, not yet run."""
Columns = dict[str, Any]


def run_or_reuse(
    output: Path,
    name: str,
    fingerprints_of: Callable[[], Columns],
    work: Callable[[Path], Columns],
    overwrite: bool = False,
) -> Columns:
    """Do the work unless its results exist already.

    It raises no Exception: errors become the columns `status` and `error` and a file in `errors/`, with a traceback if
    unexpected; the next call tries again. KeyboardInterrupt and SystemExit pass and leave nothing behind.

    Args:
        output: Folder of the batch.
        name: Of the row.
        fingerprints_of: Returns the hashes that the results depend on, `configuration` and `input`.
        work: Writes into a temporary folder, which is moved into place when complete, and returns JSON columns.
        overwrite: Replace results with other fingerprints; otherwise they are an error.

    Returns the columns, with `is_new` for whether the work was done now.
    """
    known: Columns = {"name": name, "configuration": ""}
    place = output / RUNS / name
    try:
        known |= fingerprints_of()
        record = read_record(place / RECORD)
        if record is not None and all(record.get(key) == value for key, value in known.items()):
            return record | {"is_new": False}
        if record is None and place.exists():
            raise ResultsError(f"{place}: not results of a batch: move it away")
        if record is not None and not overwrite:
            raise ResultsError(
                f"{place}: results of another configuration, input or version of the program: "
                "--overwrite replaces them"
            )
        with whole_folder(place) as folder:
            columns = known | work(folder)
            _write(folder / RECORD, columns)
        (output / ERRORS / f"{name}.json").unlink(missing_ok=True)
        return columns | {"is_new": True}
    except Exception as error:
        is_expected = isinstance(error, TorchslamError | OSError)
        return store_failure(output, known, _describe(error), "" if is_expected else traceback.format_exc())


def store_failure(output: Path, known: Columns, message: str, trace: str = "") -> Columns:
    """Record an error, on disk if possible, and return its columns."""
    columns = known | {"status": ERROR, "error": message}
    try:
        (output / ERRORS).mkdir(parents=True, exist_ok=True)
        _write(output / ERRORS / f"{known['name']}.json", columns | {"traceback": trace})
    except OSError as error:
        columns["error"] += f"; this could not be written to errors/: {error}"
    return columns | {"is_new": True}


def read_stored(output: Path, name: str, configuration: str) -> Columns:
    """Return the record of a row's results or of its error, if of this configuration; otherwise the status `open`."""
    for path in (output / RUNS / name / RECORD, output / ERRORS / f"{name}.json"):
        record = read_record(path)
        if record is not None and record.get("configuration") == configuration:
            return record
    return {"name": name, "status": OPEN}


def read_record(path: Path) -> Columns | None:
    """Read the columns of a record; None if there is no file. Raises ResultsError for any other file."""
    record = read_object(path, ResultsError)
    if record is not None and not isinstance(record.get("status"), str):
        raise ResultsError(f"{path}: not the record of a row")
    return record


def _write(path: Path, columns: Columns) -> None:
    write_whole(path, (json.dumps(columns, indent=2) + "\n").encode())


def _describe(error: Exception) -> str:
    """One line; for an unexpected error with its type and location."""
    if isinstance(error, TorchslamError | OSError):
        return printable(without_credentials(str(error)))
    place = traceback.extract_tb(error.__traceback__)[-1]
    text = printable(without_credentials(" ".join(str(error).split())))
    return f"{type(error).__name__}: {text[:1000]} ({Path(place.filename).name}:{place.lineno})"


DIGITS = 16  # hexadecimal, of a hash


@cache
def program_hash() -> str:
    """Hash the version and files of this package; another version may give other results."""
    root, kinds = Path(torchslam.__file__).parent, (".py", ".safetensors", ".js", ".css", ".html")
    paths = (path for path in sorted(root.rglob("*")) if path.suffix in kinds)
    parts = (part for path in paths for part in (path.relative_to(root).as_posix(), path.read_bytes()))
    return f"{torchslam.__version__}+{fingerprint(parts, DIGITS)}"


def hash_files(paths: list[str]) -> str:
    """Hash names, sizes and modification times of files, of folders with their content, and of patterns.

    Missing files count as such. The content is not read: that would take as long as reading all images at each start.
    Raises SequenceError for more than `MAX_FILES` files.
    """
    return fingerprint((part for path in paths for part in _parts(path)), DIGITS)


def _parts(path: str) -> Iterator[Any]:
    """What is hashed of a path: a synthetic sequence by its name, files by theirs, in the order of their names."""
    yield path if is_synthetic(path) else None
    if is_synthetic(path):
        return
    files = [path] if os.path.exists(path) else sorted(glob.glob(path))
    if os.path.isdir(path):
        files, count = [], 0
        for folder, folders, names in os.walk(path):
            folders.sort()
            count += len(folders) + len(names)
            if count > MAX_FILES:
                raise SequenceError(f"{path}: more than {MAX_FILES} files: not a sequence")
            # Without dangling links.
            files += [file for name in sorted(names) if os.path.isfile(file := os.path.join(folder, name))]
    for file in files:
        status = os.stat(file)
        yield os.path.relpath(file, Path(path).parent), status.st_size, status.st_mtime_ns
