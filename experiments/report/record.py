"""The file of figures, and where they were measured: commit, machine, versions."""

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
REPORT = ROOT / "docs" / "figures" / "report.json"
LIBRARIES = ("torchslam", "torch", "numpy", "opencv-python-headless", "opencv-python")

Report = dict[str, Any]


def beginning() -> Report:
    """The report before any run. Raises SystemExit outside of a git checkout."""
    try:
        commit = _git("rev-parse", "HEAD").strip()
        is_changed = bool(_git("status", "--porcelain", "--", "torchslam").strip())
    except (OSError, subprocess.CalledProcessError) as error:
        raise SystemExit(f"{ROOT}: a report names the commit, so it needs a git checkout: {error}") from None
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "commit": commit,
        "is_changed": is_changed,
        "machine": machine(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "versions": versions(),
        "rows": {},
    }


def machine() -> str:
    """Processor, number of processors and system, on which times depend."""
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
        processor = names[0] if names else processor
    return f"{processor}, {os.cpu_count()} processors, {platform.system()} {platform.machine()}"


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that are installed."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # only one of the two builds of OpenCV is installed
            continue
    return found


def committed() -> Report | None:
    """The report of the last commit, with which a new one is compared; None if there is none."""
    path = REPORT.relative_to(ROOT).as_posix()
    if not _git("ls-tree", "HEAD", "--", path):
        return None
    return json.loads(_git("show", f"HEAD:{path}"))


def write(report: Report, path: Path = REPORT) -> None:
    """Write the file of figures."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout
