"""The tables of the documentation that are generated from the file of figures.

A table stands between `<!-- report:begin NAME -->` and `<!-- report:end -->`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from experiments.common import table
from experiments.report.record import ROOT, Report
from experiments.report.rows import ALL

Row = dict[str, Any]
FILES = (ROOT / "README.md", ROOT / "experiments" / "sequences" / "README.md")
_BLOCK = re.compile(r"(<!-- report:begin (\w+) -->\n).*?(<!-- report:end -->)", re.DOTALL)
NO_PEERS = "Not measured: this needs the environment of the peers (`make report PEERS=DIR`).\n"


def write(report: Report, files: Iterable[Path] = FILES) -> None:
    """Replace the tables in the files."""
    for path in files:
        path.write_text(filled(path.read_text(encoding="utf-8"), report), encoding="utf-8")


def filled(text: str, report: Report) -> str:
    """The text with its tables as the report has them. Raises SystemExit for an unknown table."""

    def block(match: re.Match[str]) -> str:
        begin, name, end = match.groups()
        if name not in TABLES:
            raise SystemExit(f"report:begin {name}: no such table; there are {', '.join(TABLES)}")
        return f"{begin}{TABLES[name](report)}{end}"

    return _BLOCK.sub(block, text)


def origin(report: Report) -> str:
    """A sentence with date, commit and machine."""
    commit = report["commit"][:10] + (" with changes" if report["is_changed"] else "")
    return f"Measured on {report['date']} at commit {commit}; {report['machine']}.\n"


def accuracy(report: Report) -> str:
    """Posed frames, errors, CPU time and memory of the default command."""
    header = "recording | posed | posed online | online ATE | final ATE | map kept | CPU, s | memory, MB"
    rows = [
        [
            title,
            f"{row['posed']} of {row['frames']}" if "posed" in row else f"exit status {row['exit_status']}",
            str(row.get("online_posed", "")),
            _error(name, row, "online_ate"),
            _error(name, row, "ate"),
            row.get("kept") or "" if row.get("posed") else "none",
            f"{row['cpu_s']:.0f}",
            f"{row['peak_mb']:.0f}",
        ]
        for name, title, row in _rows(report)
    ]
    return table(header, rows)


def certainty(report: Report) -> str:
    """Which frames are called uncertain, and rightly so."""
    header = (
        "recording | judged | uncertain | of these right | of these wrong | wrong, not called uncertain | "
        "why global mapping ran"
    )
    rows = [
        [
            title,
            f"{row['judged']} by {row['judged_by']}" if "judged" in row else "",
            str(row["uncertain"]),
            *(str(row.get(name, "")) for name in ("uncertain_right", "uncertain_wrong", "certain_wrong")),
            row["why_global"],
        ]
        for _, title, row in _rows(report, "frames")
    ]
    return table(header, rows)


def speed(report: Report) -> str:
    """Times of the frames of the online stage."""
    header = "recording | median, ms | 95th percentile, ms | longest after initialization, ms | elapsed, s"
    rows = [
        [
            title,
            *(f"{row[name]:.0f}" for name in ("ms_median", "ms_p95", "ms_longest")),
            f"{row['wall_s']:.0f}",
        ]
        for _, title, row in _rows(report, "frames")
    ]
    return table(header, rows)


def peer(report: Report) -> str:
    """Agreement with pycolmap's global mapper."""
    header = (
        "recording | posed | pycolmap posed | median difference | within 2, 5, 10 % | ATE / pycolmap's | "
        "CPU, s | pycolmap CPU, s"
    )
    rows = []
    for _, title, row in _rows(report, "peer"):
        other = row["peer"]
        has_ate = row.get("ate") is not None and "ate" in other
        rows.append(
            [
                title,
                f"{row['posed']} of {row['frames']}",
                str(other["posed"]),
                f"{other['median']:.2%}" if "median" in other else "",
                ", ".join(f"{share:.0%}" for share in other.get("within", ())),
                f"{row['ate'] / other['ate']:.2f}" if has_ate else "",
                f"{row['cpu_s']:.0f}",
                f"{other['cpu_s']:.0f}",
            ]
        )
    return table(header, rows) if rows else NO_PEERS


def times(report: Report) -> str:
    """Frame times relative to ORB-SLAM3, run in turn."""
    header = (
        "recording | median, ms | ORB-SLAM3, ms | median ratio | 95th percentile ratio | ATE | ORB-SLAM3 ATE | "
        "posed | ORB-SLAM3 posed"
    )
    rows = []
    for name, title, row in _rows(report, "timed"):
        ours, other = row["timed"]["ours"], row["timed"]["orb_slam3"]
        rows.append(
            [
                f"{title}, {row['timed']['frames']} frames",
                f"{ours['ms_median']:.1f}",
                f"{other['ms_median']:.1f}",
                *(f"{ours[key] / other[key]:.2f}" for key in ("ms_median", "ms_p95")),
                *(_error(name, system, "ate") for system in (ours, other)),
                *(str(system["posed"]) for system in (ours, other)),
            ]
        )
    return table(header, rows) if rows else NO_PEERS


TABLES: dict[str, Callable[[Report], str]] = {
    make.__name__: make for make in (origin, accuracy, certainty, speed, peer, times)
}


def _rows(report: Report, key: str = "exit_status") -> Iterator[tuple[str, str, Row]]:
    """Name, title and figures of the rows that have a figure, in the order of `ALL`."""
    for name, recording in ALL.items():
        if key in (row := report["rows"].get(name, {})):
            yield name, recording.title, row


def _error(name: str, row: Row, key: str) -> str:
    """An error with its unit, or relative to the extent of the true path if the unit is arbitrary."""
    value, unit = row.get(key), ALL[name].unit
    if value is None:
        return ""
    digits = f"{value:#.2g}".rstrip(".")
    return f"{digits} {unit}" if unit else f"{value / row['extent']:.2%} of the extent"
