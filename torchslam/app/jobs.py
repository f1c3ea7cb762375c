"""The runs of a folder: each is a process `torchslam run` of its own, and its state is read from its folder.

A process holds a lock while it goes on, so that another server finds it again. A run is named by its folder's name, and
only names of folders that are there are accepted.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from torchslam.app.options import check_arguments
from torchslam.errors import ResultsError, TorchslamError
from torchslam.io.file_names import CHECKPOINT, METRICS, STAGES
from torchslam.utils.console import printable
from torchslam.utils.files import JSON_BYTES, parse_json, read_text, write_whole

DEMO = "synthetic:room"
# In the folder of a run: see `Record`; its messages; held while it goes on, with its process; there while it waits.
RECORD, LOG, LOCK, QUEUE = "app.json", "run.log", "app.lock", "app.queue"
INPUT = "input"  # file without its suffix, or folder, of what was uploaded
INTERRUPTED = "torchslam: interrupted"  # how the last message of a run that was stopped begins
MAX_QUEUED = 20  # runs that wait; more are a mistake
MAX_TITLE = 120  # characters of a file name that are shown
LOG_TAIL = 1 << 14  # bytes of the log that are shown: about 100 lines
TOOL_S = 1800.0  # seconds after which a command on a finished run is ended; tried at this value only


class State(StrEnum):
    """The state of a run; one that was stopped can be resumed."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    STOPPED = "stopped"
    FAILED = "failed"


@dataclass(frozen=True)
class Record:
    """What the page knows of a run beside its results; the content of app.json.

    Attributes:
        title: the name of the uploaded file, only to be shown.
        source: what is run: a path below the folder of all runs, or `DEMO`.
        arguments: the other arguments of `torchslam run`.
        lengths: by which its result was scaled then, each as `torchslam align --distance` takes it.
    """

    title: str
    source: str
    arguments: tuple[str, ...] = ()
    lengths: tuple[str, ...] = ()


class Runs:
    """The runs of a folder and their queue; with `max_runs` folders no run is added."""

    def __init__(self, folder: Path, max_runs: int = 100) -> None:
        self.folder, self._max_runs, self._lock = folder.absolute(), max_runs, threading.RLock()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._process: subprocess.Popen[bytes] | None = None

    def names(self) -> list[str]:
        """The names of all runs, the latest first, also of those that were started elsewhere."""
        found = [(time_of(each / RECORD, each), each.name) for each in self.folder.iterdir() if is_run(each)]
        return [name for _, name in sorted(found, reverse=True)]

    def path(self, name: str) -> Path:
        """The folder of a run. Raises ResultsError for a name that is none of a run."""
        path = self.folder / name
        if name in ("", ".", "..") or path.parent != self.folder or not is_run(path):
            raise ResultsError(f"no run {printable(name)[:MAX_TITLE]!r}")
        return path

    def recordings(self) -> list[str]:
        """The names of other files and folders in the folder, which may be recordings; no hidden ones and no links."""
        found = [each for each in self.folder.iterdir() if not each.name.startswith(".") and not is_run(each)]
        return sorted(each.name for each in found if not each.is_symlink())

    def record(self, name: str) -> Record:
        """What is known of a run."""
        return read_record(self.path(name))

    def state(self, name: str) -> State:
        """The state of a run, from its folder."""
        path = self.path(name)
        is_queued = (path / QUEUE).exists()  # looked at first: it goes only once the lock is held
        if is_held(path):
            return State.RUNNING
        if is_queued:
            return State.QUEUED
        if is_begun(path):
            return State.STOPPED
        if (path / METRICS).exists():
            return State.DONE
        last = (log_tail(path) or [INTERRUPTED])[-1]
        return State.STOPPED if last.startswith(INTERRUPTED) else State.FAILED

    def seconds(self, name: str) -> float:
        """How long the process of a run has gone on, or went on; 0 before."""
        path = self.path(name)
        end = time.time() if is_held(path) else time_of(path / LOG)
        return max(0.0, end - time_of(path / LOCK)) if (path / LOCK).exists() else 0.0

    def running(self) -> str | None:
        """The name of the run that goes on."""
        return next((name for name in self.names() if is_held(self.folder / name)), None)

    def add(
        self,
        title: str,
        source: str,
        arguments: Iterable[str] = (),
        upload: Path | None = None,
        files: Iterable[Path] = (),
    ) -> str:
        """Queue a run and return its name; `upload` is moved into its folder as its source, `files` are copied there.

        Raises TorchslamError if there are too many runs, or for an argument that the page does not give.
        """
        with self._lock:
            arguments, names = tuple(arguments), self.names()
            check_arguments(arguments)
            if len(names) >= self._max_runs:
                raise ResultsError(f"{len(names)} runs in the folder: delete some, or raise --max-runs")
            if len(list(self.folder.glob(f"*/{QUEUE}"))) >= MAX_QUEUED:
                raise ResultsError(f"{MAX_QUEUED} runs wait already")
            stem = f"{time.strftime('%Y%m%d-%H%M%S')}-{slug(Path(title).stem)}"
            paths = (self.folder / (stem + end) for end in ("", *(f"-{n}" for n in range(2, 100))))
            path = next(path for path in paths if not path.exists())
            path.mkdir()
            try:
                for each in files:
                    shutil.copyfile(each, path / each.name)
                source = source if upload is None else f"{path.name}/{upload.name}"
                write_record(path, Record(shown(title), source, arguments))
                if upload is not None:
                    upload.rename(path / upload.name)
            except OSError:
                shutil.rmtree(path)  # the upload is still where it was
                raise
            (path / QUEUE).touch()
        return path.name

    def resume(self, name: str) -> None:
        """Queue a run again, which goes on from its checkpoint, or begins anew without one."""
        with self._lock:
            if (state := self.state(name)) not in (State.STOPPED, State.FAILED):
                raise ResultsError(f"{self.record(name).title} is {state}")
            write_record(self.path(name), replace(self.record(name), lengths=()))  # it measures anew
            (self.path(name) / QUEUE).touch()

    def scale(self, name: str, length: Sequence[str]) -> None:
        """Bring a result into meters by two clicks and the meters between them. Raises ResultsError."""
        path, record = self.path(name), self.record(name)
        tool(["align", str(path), "--distance", *length])
        write_record(path, replace(record, lengths=(*record.lengths, " ".join(length))))

    def stop(self, name: str) -> None:
        """End a run, which writes what it has; a queued one leaves the queue. Nothing for one that has ended."""
        with self._lock:
            path, state = self.path(name), self.state(name)
            if state is State.QUEUED:
                (path / QUEUE).unlink()
            elif state is State.RUNNING:
                with contextlib.suppress(ProcessLookupError):  # it has just ended
                    os.kill(int((path / LOCK).read_text()), signal.SIGINT)

    def delete(self, name: str) -> None:
        """Delete a run with all of its files. Raises ResultsError for one that goes on."""
        with self._lock:
            path = self.path(name)
            if is_held(path):
                raise ResultsError("a run that goes on cannot be deleted: stop it first")
            shutil.rmtree(path)

    def advance(self) -> None:
        """Start the next run of the queue if none goes on."""
        with self._lock:
            waiting = [path for path in self.folder.glob(f"*/{QUEUE}") if is_run(path.parent)]
            if self._process is not None and self._process.poll() is None:
                return
            if waiting and self.running() is None:
                first = min(waiting, key=time_of)
                try:
                    self._start(first.parent.name)
                finally:
                    first.unlink()

    def command(self, name: str) -> list[str]:
        """The words after `torchslam` of the command of a run, with absolute paths.

        Raises TorchslamError for a record from elsewhere that names something outside of the folder, or code.
        """
        record = self.record(name)
        check_arguments(record.arguments)
        found = (self.folder / record.source).resolve()
        is_inside = bool(record.source) and found.is_relative_to(self.folder.resolve()) and found.exists()
        if record.source != DEMO and not is_inside:
            raise ResultsError(f"{record.title}: its recording is not in the folder of the page")
        source = DEMO if record.source == DEMO else str(self.folder / record.source)
        return ["run", source, "--output", str(self.path(name)), *record.arguments]

    def _start(self, name: str) -> None:
        path, options = self.path(name), dict[str, Any](stdin=subprocess.DEVNULL, start_new_session=True)
        environment = os.environ | {"TORCHSLAM_LOG_INTERVAL": "1", "PYTHONUNBUFFERED": "1"}
        # The lock is held by the process and its workers until all have ended.
        with (path / LOG).open("ab") as log, locked(path / LOCK) as lock:
            options |= {"stdout": log, "stderr": log, "cwd": path, "env": environment, "pass_fds": [lock]}
            try:
                words = [*self.command(name), "--live", "--resume" if is_begun(path) else "--overwrite"]
                self._process = subprocess.Popen([sys.executable, "-m", "torchslam", *words], **options)
            except (TorchslamError, OSError) as error:
                log.write(f"torchslam: error: {error}\n".encode())
                raise
            os.truncate(lock, 0)
            os.write(lock, str(self._process.pid).encode())


@contextlib.contextmanager
def locked(path: Path) -> Iterator[int]:
    """Hold a lock, and yield its file's number. Raises BlockingIOError if another process holds it."""
    with path.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield file.fileno()


def tool(words: Sequence[str], timeout_s: float = TOOL_S) -> str:
    """Run `torchslam WORDS` at once and return what it prints. Raises ResultsError with its message."""
    command = [sys.executable, "-m", "torchslam", *words]
    options: dict[str, Any] = {"text": True, "errors": "replace", "timeout": timeout_s}
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, **options)
    except subprocess.TimeoutExpired:
        raise ResultsError(f"torchslam {words[0]} took more than {timeout_s:.0f} s and was ended") from None
    if done.returncode == 0:
        return str(done.stdout)
    lines = [line for line in done.stderr.splitlines() if line.strip()] or [f"status {done.returncode}"]
    errors = [line for line in lines if line.startswith("torchslam: error: ")]
    raise ResultsError(printable((errors or lines)[-1].removeprefix("torchslam: ").removeprefix("error: ")))


def without_paths(text: str, folder: Path, title: str = "") -> str:
    """A message in which a title, or the name alone, stands for each file below a folder."""
    below = re.escape(str(folder)) + r"/[^\s:'\"]*"
    return re.sub(below, lambda found: title or Path(found[0]).name, text)


def is_run(path: Path) -> bool:
    """Whether a folder is a run of the page or results of `torchslam run`; a link is none."""
    names = (RECORD, METRICS, CHECKPOINT)
    return path.is_dir() and not path.is_symlink() and any((path / name).is_file() for name in names)


def is_begun(path: Path) -> bool:
    """Whether a folder has a run that can be resumed."""
    return (path / CHECKPOINT).exists() or (path / STAGES).exists()


def is_held(path: Path) -> bool:
    """Whether a process of the run in a folder goes on."""
    with contextlib.suppress(FileNotFoundError), (path / LOCK).open("rb") as lock:  # or just deleted
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def time_of(*paths: Path) -> float:
    """When the first of the paths that is there was written, seconds since 1970; 0 without one."""
    for path in paths:
        with contextlib.suppress(FileNotFoundError):  # it may just be deleted
            return path.stat().st_mtime
    return 0.0


def read_record(path: Path) -> Record:
    """Read app.json; of results from elsewhere, and where it is damaged, the title names the folder."""
    try:
        content = parse_json(read_text(path / RECORD, JSON_BYTES, "a record"))
        words, lengths = (tuple(map(str, content.get(each, ()))) for each in ("arguments", "lengths"))
        return Record(str(content["title"]), str(content["source"]), words, lengths)
    except FileNotFoundError:
        return Record(shown(path.name), "")
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return Record(f"{shown(path.name)} (its {RECORD} is damaged)", "")


def write_record(path: Path, record: Record) -> None:
    """Write app.json, whole or not at all."""
    write_whole(path / RECORD, (json.dumps(asdict(record), indent=2) + "\n").encode())


def log_tail(path: Path) -> list[str]:
    """The last lines of the log of a run, with control characters escaped; none if there is no log."""
    try:
        with (path / LOG).open("rb") as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - LOG_TAIL))
            return list(map(printable, log.read().decode("utf-8", "replace").splitlines()))
    except FileNotFoundError:
        return []


def progress_of(log: Iterable[str]) -> tuple[str, float]:
    """The last progress line of a log without its bar, and the share of its stage that is done."""
    for line in reversed(list(log)):
        count = re.search(r"(\d+)(?:/| of at most )(\d+)", line)
        if "|" in line and count is not None and not line.startswith("torchslam"):
            return re.sub(r"\s*\|[^|]*\|\s*", " · ", line), min(1.0, int(count[1]) / max(1, int(count[2])))
    return "", 0.0


def slug(text: str) -> str:
    """A short name for a folder, of ASCII letters, digits and hyphens."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", plain).strip("-")[:40].strip("-") or "run"


def stored_name(name: str, stem: str = INPUT) -> str:
    """The name under which an uploaded file is stored: nothing of its name but a plain suffix."""
    suffix = Path(name.replace("\\", "/")).suffix.lower()
    return stem + (suffix if re.fullmatch(r"\.[a-z0-9]{1,8}", suffix) else "")


def shown(name: str) -> str:
    """The name of a file as it is shown: without folders and control characters, not too long."""
    return printable(name.replace("\\", "/").rpartition("/")[2])[:MAX_TITLE] or "recording"
