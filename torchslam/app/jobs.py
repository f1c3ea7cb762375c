"""The runs of a folder: each is a process `torchslam run` of its own, and its state is read from its folder.

Whether a process goes on is known by a lock that it holds, so that another server finds it again. A run is only ever
named by its folder's name, and only names of folders that are there are accepted.
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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType

from torchslam.app.options import check_arguments
from torchslam.errors import ResultsError
from torchslam.io.file_names import CHECKPOINT, METRICS, STAGES
from torchslam.utils.console import printable
from torchslam.utils.files import JSON_BYTES, parse_json, read_text, write_whole

DEMO = "synthetic:room"
RECORD = "app.json"  # what the page knows of a run
LOG = "run.log"
LOCK = "app.lock"
INPUT = "input"  # file without its suffix, or folder, of what was uploaded
MAX_QUEUED = 20  # runs that wait; more are a mistake
MAX_TITLE = 120  # characters of a file name that are shown
LOG_TAIL = 1 << 14  # bytes of the log that are shown: the last 100 lines
LOG_INTERVAL_S = 1  # between two progress lines in the log; the page is drawn as often
TOOL_S = 1800.0
"""Seconds after which a command on a finished run, such as an export, is ended. Tried at this value only."""
SUFFIX = re.compile(r"\.[a-z0-9]{1,8}")
"""Suffixes of files that are kept; a reader refuses those that it does not know."""


class State(StrEnum):
    """The state of a run."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    STOPPED = "stopped"
    """Ended before its end; it can be resumed."""
    FAILED = "failed"


@dataclass(frozen=True)
class Record:
    """What the page knows of a run beside its results; the content of app.json.

    Attributes:
        title: what the user calls it: the name of the uploaded file, only to be shown.
        source: what is run: a path below the folder, or synthetic:room.
        arguments: the other arguments of `torchslam run`.
        queued, started, ended: seconds since 1970; 0 before.
        status: exit status of the last process; None before, or if it is unknown.
        pid: of the last process, valid while the lock is held.
    """

    title: str
    source: str
    arguments: tuple[str, ...] = ()
    queued: float = 0.0
    started: float = 0.0
    ended: float = 0.0
    status: int | None = None
    pid: int = 0


class Runs:
    """The runs of a folder, and the queue of those that wait for their turn.

    Args:
        folder: of all runs; created if it is missing.
        max_runs: number of folders from which on no run is added.
    """

    def __init__(self, folder: Path, max_runs: int = 100) -> None:
        self.folder, self._max_runs = folder.absolute(), max_runs
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = threading.RLock()
        self._process: subprocess.Popen[bytes] | None = None
        self._current = ""

    def names(self) -> list[str]:
        """The names of all runs, the latest first, also of those that were started elsewhere."""
        found = [each for each in self.folder.iterdir() if is_run(each)]
        return [each.name for each in sorted(found, key=_time_of, reverse=True)]

    def path(self, name: str) -> Path:
        """The folder of a run. Raises ResultsError for a name that is none of a run."""
        if name not in self.names():
            raise ResultsError(f"no run {printable(name)[:MAX_TITLE]!r}")
        return self.folder / name

    def recordings(self) -> list[str]:
        """The names of recordings in the folder, which can be run: neither runs nor hidden."""
        found = [each for each in self.folder.iterdir() if not each.name.startswith(".") and not is_run(each)]
        return sorted(each.name for each in found if not each.is_symlink())

    def record(self, name: str) -> Record:
        """What is known of a run."""
        return read_record(self.path(name))

    def state(self, name: str) -> State:
        """The state of a run, from its folder."""
        path = self.path(name)
        record = read_record(path)
        if is_held(path):
            return State.RUNNING
        if record.queued and not record.started:
            return State.QUEUED
        unfinished = (path / CHECKPOINT).exists() or (path / STAGES).exists()
        if (path / METRICS).exists() and not unfinished:
            return State.DONE
        return State.STOPPED if unfinished or record.status in (None, 130, 143) else State.FAILED

    def add(
        self,
        title: str,
        source: str,
        arguments: Iterable[str],
        uploaded: Path | None = None,
        files: Mapping[str, Path] = MappingProxyType({}),
    ) -> str:
        """Add a run to the queue and return its name.

        Args:
            title: as in `Record`.
            source: as in `Record`.
            arguments: as in `Record`.
            uploaded: moved into the folder of the run, and its source.
            files: moved there as well; the arguments have their names.

        Raises:
            ResultsError: there are too many runs.
        """
        with self._lock:
            names = self.names()
            if len(names) >= self._max_runs:
                raise ResultsError(
                    f"{len(names)} runs in the folder: delete some, or start with a larger --max-runs"
                )
            if sum(self.state(name) is State.QUEUED for name in names) >= MAX_QUEUED:
                raise ResultsError(f"{MAX_QUEUED} runs wait already")
            stem, number = f"{time.strftime('%Y%m%d-%H%M%S')}-{slug(Path(title).stem)}", 1
            name = stem
            while (self.folder / name).exists():
                number += 1
                name = f"{stem}-{number}"
            path = self.folder / name
            path.mkdir()
            if uploaded is not None:
                moved = path / uploaded.name
                uploaded.rename(moved)
                source = f"{name}/{moved.name}"
            for each in files.values():
                shutil.copyfile(each, path / each.name)
            write_record(path, Record(shown(title), source, tuple(arguments), queued=time.time()))
            self.advance()
        return name

    def resume(self, name: str) -> None:
        """Queue a run again, which goes on from its checkpoint."""
        with self._lock:
            path, record = self.path(name), self.record(name)
            if self.state(name) not in (State.STOPPED, State.FAILED):
                raise ResultsError(f"{record.title} is {self.state(name)}")
            write_record(path, replace(record, queued=time.time(), started=0.0, ended=0.0, status=None))
            self.advance()

    def stop(self, name: str) -> None:
        """End a run, which writes what it has; a queued one leaves the queue. Nothing for one that has ended."""
        with self._lock:
            path, record, state = self.path(name), self.record(name), self.state(name)
            if state is State.RUNNING and record.pid > 0:
                with contextlib.suppress(ProcessLookupError):  # it has just ended
                    os.kill(record.pid, signal.SIGINT)
            elif state is State.QUEUED:
                write_record(path, replace(record, started=time.time(), ended=time.time(), status=130))

    def delete(self, name: str) -> None:
        """Delete a run with all of its files. Raises ResultsError for one that is running."""
        with self._lock:
            path = self.path(name)
            if is_held(path):
                raise ResultsError("a run that goes on cannot be deleted: stop it first")
            shutil.rmtree(path)

    def running(self) -> str | None:
        """The name of the run that goes on."""
        return next((name for name in self.names() if is_held(self.folder / name)), None)

    def advance(self) -> None:
        """Note the end of the process, and start the next run of the queue if none goes on."""
        with self._lock:
            if self._process is not None and self._process.poll() is not None:
                path = self.folder / self._current
                if path.is_dir():
                    ended = replace(read_record(path), ended=time.time(), status=self._process.returncode)
                    write_record(path, ended)
                self._process = None
            if self._process is not None or self.running() is not None:
                return
            waiting = [name for name in self.names() if self.state(name) is State.QUEUED]
            if waiting:
                self._start(min(waiting, key=lambda name: self.record(name).queued))

    def command(self, name: str) -> list[str]:
        """The words of the command that makes a run, after `torchslam`; paths are absolute.

        Raises TorchslamError for a record from elsewhere that names something outside of the folder, or code.
        """
        record = self.record(name)
        check_arguments(record.arguments)
        source = record.source
        if source != DEMO:
            found = (self.folder / source).resolve()
            if not source or not found.is_relative_to(self.folder.resolve()) or not found.exists():
                raise ResultsError(f"{record.title}: its recording is not in the folder of the page")
            source = str(self.folder / source)
        return ["run", source, "--output", str(self.path(name)), *record.arguments]

    def _start(self, name: str) -> None:
        path, record = self.path(name), self.record(name)
        is_begun = (path / CHECKPOINT).exists() or (path / STAGES).exists()
        words = [*self.command(name), "--live", "--resume" if is_begun else "--overwrite"]
        environment = os.environ | {"TORCHSLAM_LOG_INTERVAL": str(LOG_INTERVAL_S), "PYTHONUNBUFFERED": "1"}
        with (path / LOG).open("ab") as log, (path / LOCK).open("ab") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # held by the process and its workers until all have ended
            self._process = subprocess.Popen(
                [sys.executable, "-m", "torchslam", *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=path,
                env=environment,
                pass_fds=(lock.fileno(),),
                start_new_session=True,
            )
        self._current = name
        begun = replace(record, started=time.time(), ended=0.0, status=None, pid=self._process.pid)
        write_record(path, begun)


def tool(words: Sequence[str], timeout_s: float = TOOL_S) -> subprocess.CompletedProcess[str]:
    """Run `torchslam WORDS` at once; its last line of stderr is its message if it fails."""
    return subprocess.run(
        [sys.executable, "-m", "torchslam", *words],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout_s,
        check=False,
    )


def message_of(done: subprocess.CompletedProcess[str], folder: Path, title: str = "") -> str:
    """The message of a command that failed, without names of folders; `title` stands for the uploaded file."""
    lines = [line for line in done.stderr.splitlines() if line.strip()] or [
        f"ended with status {done.returncode}"
    ]
    errors = [line for line in lines if line.startswith("torchslam: error: ")]
    text = (errors or lines)[-1].removeprefix("torchslam: ").removeprefix("error: ")
    text = re.sub(re.escape(str(folder)) + r"/[^\s:'\"]*", lambda found: title or Path(found[0]).name, text)
    return printable(text)


def is_run(path: Path) -> bool:
    """Whether a folder is a run of the page or results of `torchslam run`; a link is none."""
    if path.is_symlink() or not path.is_dir():
        return False
    return any((path / name).is_file() for name in (RECORD, METRICS, CHECKPOINT))


def is_held(path: Path) -> bool:
    """Whether a process of the run in a folder goes on."""
    try:
        with (path / LOCK).open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:  # no run of the page, or just deleted
        pass
    return False


def read_record(path: Path) -> Record:
    """Read app.json; of results that were made elsewhere, the title is the name of the folder.

    Raises ResultsError if it is damaged.
    """
    try:
        content = parse_json(read_text(path / RECORD, JSON_BYTES, "a record"))
        return Record(**content | {"arguments": tuple(map(str, content.get("arguments", ())))})
    except FileNotFoundError:
        return Record(shown(path.name), "")
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ResultsError(f"{path / RECORD}: not a record of the page: {error}") from None


def write_record(path: Path, record: Record) -> None:
    """Write app.json, whole or not at all."""
    write_whole(path / RECORD, (json.dumps(asdict(record), indent=2) + "\n").encode())


def log_tail(path: Path) -> str:
    """The end of the log of a run, with control characters escaped; empty if there is none."""
    try:
        with (path / LOG).open("rb") as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - LOG_TAIL))
            lines = log.read().decode("utf-8", "replace").splitlines()
    except FileNotFoundError:
        return ""
    return "\n".join(map(printable, lines))


def progress_of(log: str) -> tuple[str, float | None]:
    """The last progress line of a log, and the share of its stage that is done; messages are left out."""
    for line in reversed(log.splitlines()):
        words = line.replace("█", "").strip()
        count = re.search(r"(\d+)(?:/| of at most )(\d+)", words)
        if "|" in line and count is not None and not line.startswith("torchslam"):
            return re.sub(r"\|\s*\S*\s*\|", "·", words), min(1.0, int(count[1]) / max(1, int(count[2])))
    return "", None


def messages_of(log: str) -> list[str]:
    """The messages of a run in its log: those of torchslam, not the progress."""
    lines = [line.removeprefix("torchslam: ") for line in log.splitlines() if line.startswith("torchslam: ")]
    return [line for line, before in zip(lines, ["", *lines], strict=False) if line != before]


def slug(text: str) -> str:
    """A short name for a folder, of ASCII letters, digits and hyphens."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", plain).strip("-")[:40].strip("-") or "run"


def stored_name(name: str, stem: str = INPUT) -> str:
    """The name under which an uploaded file is stored: nothing of its name but a plain suffix."""
    suffix = Path(name.replace("\\", "/")).suffix.lower()
    return stem + (suffix if SUFFIX.fullmatch(suffix) else "")


def shown(name: str) -> str:
    """The name of a file as it is shown: without folders and control characters, not too long."""
    return printable(name.replace("\\", "/").rpartition("/")[2])[:MAX_TITLE] or "recording"


def _time_of(path: Path) -> float:
    """When a run was added, or its folder was changed."""
    try:
        return read_record(path).queued or path.stat().st_mtime
    except (ResultsError, OSError):
        return 0.0
