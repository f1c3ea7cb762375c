"""A line of the history: which commit, where, with what, and the figures."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
HISTORY = ROOT / "docs" / "figures" / "history.jsonl"
OURS = (
    "docs/figures/history.jsonl",
    "docs/images/history.png",
    "docs/history.md",
)  # written by a report itself
LIBRARIES = ("torchslam", "torch", "numpy", "opencv-python-headless", "opencv-python")
QUIET = 0.5
"""Load above which times are ignored, since other processes use the machine."""

Record = dict[str, Any]


def beginning() -> Record:
    """The record before any run. Raises SystemExit outside of a git checkout."""
    return {
        "time": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        **commit(),
        "machine": machine(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "versions": versions(),
        "sequences": {},
        "benchmarks": {},
    }


def commit() -> Record:
    """The commit, and whether there are changes that are not in it."""
    try:
        head = _git("rev-parse", "HEAD").strip()
        changed = [line[3:] for line in _git("status", "--porcelain").splitlines()]
    except (OSError, subprocess.CalledProcessError) as error:
        raise SystemExit(f"{ROOT}: a report names the commit, so it needs a git checkout: {error}") from None
    return {"commit": head, "is_changed": any(path not in OURS for path in changed)}


def machine() -> str:
    """Processor, number of processors and system, which times depend on."""
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.partition(":")[2].strip()
            for line in cpuinfo.read_text().splitlines()
            if "model name" in line
        ]
        processor = names[0] if names else processor
    return f"{processor}, {os.cpu_count()} processors, {platform.system()} {platform.machine()}"


def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # one of the two builds of OpenCV always is
            continue
    return found


def is_quiet(record: Record) -> bool:
    """Whether the times of a record can be compared with others of the same machine."""
    return record["load"] is not None and record["load"] <= QUIET


def read_history(path: Path = HISTORY) -> list[Record]:
    """All records, oldest first; none where there is no file. Raises SystemExit naming the line that is none."""
    if not path.exists():
        return []
    records = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            record = json.loads(line)
            missing = [
                name
                for name in ("commit", "machine", "load", "sequences", "benchmarks")
                if name not in record
            ]
        except (ValueError, TypeError) as error:
            raise SystemExit(f"{path}, line {number}: not a record: {error}") from None
        if missing:
            raise SystemExit(f"{path}, line {number}: not a record: {', '.join(missing)} missing")
        records.append(record)
    return records


def append(record: Record, path: Path = HISTORY) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout
