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
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path

from torchslam.app.options import check_arguments
from torchslam.errors import ResultsError
from torchslam.io.file_names import CHECKPOINT, METRICS, STAGES
from torchslam.utils.console import printable
from torchslam.utils.files import JSON_BYTES, parse_json, read_text, write_whole

DEMO = "synthetic:room"
RECORD, LOG, LOCK = "app.json", "run.log", "app.lock"  # in the folder of a run
INPUT = "input"  # file without its suffix, or folder, of what was uploaded
MAX_QUEUED = 20  # runs that wait; more are a mistake
MAX_TITLE = 120  # characters of a file name that are shown
LOG_TAIL = 1 << 14  # bytes of the log that are shown: about 100 lines
TOOL_S = 1800.0  # seconds after which a command on a finished run is ended; tried at this value only
# None: of another server's run.
STOPPED_STATUS = (None, 130, 143, -signal.SIGINT, -signal.SIGTERM, -signal.SIGKILL)


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
    """The runs of a folder and their queue; with `max_runs` folders no run is added."""

    def __init__(self, folder: Path, max_runs: int = 100) -> None:
        self.folder, self._max_runs = folder.absolute(), max_runs
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = threading.RLock()
        self._current: tuple[str, subprocess.Popen[bytes]] | None = None

    def names(self) -> list[str]:
        """The names of all runs, the latest first, also of those that were started elsewhere."""
        found = [each for each in self.folder.iterdir() if is_run(each)]
        return [each.name for each in sorted(found, key=_time_of, reverse=True)]

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
        path, record = self.path(name), self.record(name)
        if is_held(path):
            return State.RUNNING
        if record.queued and not record.started:
            return State.QUEUED
        if (path / METRICS).exists() and not is_begun(path):
            return State.DONE
        return State.STOPPED if is_begun(path) or record.status in STOPPED_STATUS else State.FAILED

    def running(self) -> str | None:
        """The name of the run that goes on."""
        return next((name for name in self.names() if is_held(self.folder / name)), None)

    def add(
        self,
        title: str,
        source: str,
        arguments: Iterable[str],
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
                raise ResultsError(
                    f"{len(names)} runs in the folder: delete some, or start with a larger --max-runs"
                )
            if sum(self.state(name) is State.QUEUED for name in names) >= MAX_QUEUED:
                raise ResultsError(f"{MAX_QUEUED} runs wait already")
            stem, number = f"{time.strftime('%Y%m%d-%H%M%S')}-{slug(Path(title).stem)}", 1
            while (path := self.folder / (stem if number == 1 else f"{stem}-{number}")).exists():
                number += 1
            path.mkdir()
            if upload is not None:
                upload.rename(path / upload.name)
                source = f"{path.name}/{upload.name}"
            for each in files:
                shutil.copyfile(each, path / each.name)
            write_record(path, Record(shown(title), source, arguments, queued=time.time()))
        return path.name

    def resume(self, name: str) -> None:
        """Queue a run again, which goes on from its checkpoint, or begins anew without one."""
        with self._lock:
            record = self.record(name)
            if self.state(name) not in (State.STOPPED, State.FAILED):
                raise ResultsError(f"{record.title} is {self.state(name)}")
            write_record(
                self.path(name), replace(record, queued=time.time(), started=0.0, ended=0.0, status=None)
            )

    def stop(self, name: str) -> None:
        """End a run, which writes what it has; a queued one leaves the queue. Nothing for one that has ended."""
        with self._lock:
            record, state = self.record(name), self.state(name)
            if state is State.RUNNING and record.pid > 0:
                with contextlib.suppress(ProcessLookupError):  # it has just ended
                    os.kill(record.pid, signal.SIGINT)
            elif state is State.QUEUED:
                write_record(
                    self.path(name), replace(record, started=time.time(), ended=time.time(), status=130)
                )

    def delete(self, name: str) -> None:
        """Delete a run with all of its files. Raises ResultsError for one that goes on."""
        with self._lock:
            path = self.path(name)
            if is_held(path):
                raise ResultsError("a run that goes on cannot be deleted: stop it first")
            shutil.rmtree(path)

    def advance(self) -> None:
        """Note the end of the process, and start the next run of the queue if none goes on."""
        with self._lock:
            if self._current is not None and self._current[1].poll() is not None:
                name, process = self._current
                if name in self.names():
                    ended = replace(self.record(name), ended=time.time(), status=process.returncode)
                    write_record(self.path(name), ended)
                self._current = None
            waiting = [name for name in self.names() if self.state(name) is State.QUEUED]
            if waiting and self._current is None and self.running() is None:
                self._start(min(waiting, key=lambda name: self.record(name).queued))

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
        path, record = self.path(name), replace(self.record(name), started=time.time())
        write_record(path, replace(record, ended=record.started, status=2))  # if it cannot be started
        words = [*self.command(name), "--live", "--resume" if is_begun(path) else "--overwrite"]
        environment = os.environ | {"TORCHSLAM_LOG_INTERVAL": "1", "PYTHONUNBUFFERED": "1"}
        with (path / LOG).open("ab") as log, (path / LOCK).open("ab") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # held by the process and its workers until all have ended
            process = subprocess.Popen(
                [sys.executable, "-m", "torchslam", *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=path,
                env=environment,
                pass_fds=(lock.fileno(),),
                start_new_session=True,
            )
        self._current = name, process
        write_record(path, replace(record, ended=0.0, status=None, pid=process.pid))


def tool(words: Sequence[str], folder: Path, title: str = "", timeout_s: float = TOOL_S) -> str:
    """Run `torchslam WORDS` at once and return what it prints.

    Raises ResultsError with its message, in which `title` stands for files below the folder.
    """
    command = [sys.executable, "-m", "torchslam", *words]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
        )
    except subprocess.TimeoutExpired:
        raise ResultsError(f"torchslam {words[0]} took more than {timeout_s:.0f} s and was ended") from None
    if done.returncode == 0:
        return done.stdout
    lines = [line for line in done.stderr.splitlines() if line.strip()] or [
        f"ended with status {done.returncode}"
    ]
    errors = [line for line in lines if line.startswith("torchslam: error: ")]
    text = (errors or lines)[-1].removeprefix("torchslam: ").removeprefix("error: ")
    below = re.escape(str(folder)) + r"/[^\s:'\"]*"
    raise ResultsError(printable(re.sub(below, lambda found: title or Path(found[0]).name, text)))


def is_run(path: Path) -> bool:
    """Whether a folder is a run of the page or results of `torchslam run`; a link is none."""
    names = (RECORD, METRICS, CHECKPOINT)
    return path.is_dir() and not path.is_symlink() and any((path / name).is_file() for name in names)


def is_begun(path: Path) -> bool:
    """Whether a folder has a run that can be resumed."""
    return (path / CHECKPOINT).exists() or (path / STAGES).exists()


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
    """Read app.json; of results from elsewhere, and where it is damaged, the title names the folder."""
    try:
        content = parse_json(read_text(path / RECORD, JSON_BYTES, "a record"))
        record = Record(**content | {"arguments": tuple(map(str, content["arguments"]))})
        (
            float(record.queued + record.started + record.ended + record.pid),
            str.strip(record.title + record.source),
        )
        return record
    except FileNotFoundError:
        return Record(shown(path.name), "")
    except (OSError, ValueError, TypeError, KeyError):
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


def _time_of(path: Path) -> float:
    with contextlib.suppress(FileNotFoundError):  # it was just deleted
        return read_record(path).queued or path.stat().st_mtime
    return 0.0
