"""Draw the history of the figures, and write the page of the documentation that shows it.

    python -m experiments.report.draw [--history FILE]

Writes docs/images/history.png and docs/history.md.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.common import parser_of, table
from experiments.report.record import HISTORY, ROOT, Record, is_quiet, read_history
from torchslam.io.plots.style import ACCENT, ESTIMATE, house_style, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DOCS = ROOT / "docs"
COLUMNS = 3
SIZE = (3.4, 1.9)  # inches, of one sequence
NEWEST = 60  # reports that are drawn
"""More would be too narrow to be distinguished."""
INTRODUCTION = """\
# History of the figures

`make report` runs every available sequence with the default configuration, and the quick benchmarks, appends one
line to `docs/figures/history.jsonl` (commit, machine, versions, figures, hash of the bytes of each trajectory), and
regenerates this page. It fails if a figure is more than a tenth worse than the last one: errors and posed frames on any
machine, times only if the same machine was idle both times. `--accept REASON` accepts figures that got worse.
"""


def draw(history: list[Record], path: Path) -> None:
    """A small picture per sequence: ATE (posed share where there is none), and CPU seconds on a quiet machine."""
    names = list(dict.fromkeys(name for record in history for name in record["sequences"]))
    rows = math.ceil(len(names) / COLUMNS)
    with house_style():
        figure = new_figure(COLUMNS * SIZE[0], rows * SIZE[1])
        grid = figure.subplots(rows, COLUMNS, squeeze=False)
        for name, axes in zip(names, grid.flat, strict=False):
            _draw_one(axes, name, [record for record in history if name in record["sequences"]])
        for axes in list(grid.flat)[len(names) :]:
            axes.set_axis_off()
    save(figure, path)


def _draw_one(axes: Axes, name: str, records: list[Record]) -> None:
    figures = [record["sequences"][name] for record in records]
    labels = [record["commit"][:7] for record in records]
    has_truth = any("ate" in each for each in figures)
    values = [each.get("ate", math.nan) if has_truth else each["posed"] for each in figures]
    axes.plot(values, "o-", color=ESTIMATE, markersize=3)
    top = max((value for value in values if not math.isnan(value)), default=0.0)
    axes.set_ylim(0, 1.25 * top or 1.0)
    axes.set_ylabel("ATE" if has_truth else "posed frames", color=ESTIMATE)
    axes.set_title(name)
    shown = sorted({0, len(labels) - 1})
    axes.set_xticks(shown, [labels[k] for k in shown])
    seconds = [
        each["cpu_s"] if is_quiet(record) and record["machine"] == records[-1]["machine"] else math.nan
        for record, each in zip(records, figures, strict=True)
    ]
    if not all(map(math.isnan, seconds)):
        right = axes.twinx()
        right.plot(seconds, ".--", color=ACCENT, linewidth=0.8, markersize=3)
        right.set_ylim(0, 1.25 * max(value for value in seconds if not math.isnan(value)))
        right.set_ylabel("CPU, s", color=ACCENT)
        right.grid(False)


def page(history: list[Record]) -> str:
    """docs/history.md: the drawing, and the newest figures of every sequence and benchmark."""
    lines = [*INTRODUCTION.splitlines(), ""]
    if not history:
        return "\n".join([*lines, "There is no report yet.", ""])
    lines += ["![ATE and CPU time of every sequence, report by report](images/history.png)", ""]
    lines += [
        f"The newest figures of each sequence and benchmark, the last ones of {history[-1]['time'][:10]}: those of the "
        "README are of today where they differ. Times are CPU times, in parentheses if the machine was busy.",
        "",
    ]
    newest: dict[str, Record] = {}
    for record in history:
        newest |= dict.fromkeys(record["sequences"], record)
    header = (
        "sequence | posed | ATE | of the extent | keyframes | CPU, s | median, ms | 95 %, ms | commit | bytes"
    )
    lines.append(table(header, [_row(name, record) for name, record in newest.items()]))
    measured: dict[str, Record] = {}
    for record in history:
        measured |= dict.fromkeys(record["benchmarks"], record)
    rows = [
        [
            name,
            f"{found['error']:.4g}" if "error" in found else "",
            _time(record, found["ms"]),
            record["commit"][:7],
        ]
        for name, record in measured.items()
        for found in [record["benchmarks"][name]]
    ]
    if rows:
        lines.append(table(["benchmark", "error", "ms", "commit"], rows))
    accepted = [record for record in history if record.get("worse")]
    if accepted:
        lines += ["What got worse, and why that was accepted:", ""]
        lines += [
            f"- {record['commit'][:7]}, {record.get('accepted') or 'not accepted'}: {'; '.join(record['worse'])}"
            for record in accepted
        ]
        lines.append("")
    return "\n".join([*lines, f"Machine of the newest: {history[-1]['machine']}.", ""])


def _row(name: str, record: Record) -> list[str]:
    found: dict[str, Any] = record["sequences"][name]
    has_truth = "ate" in found
    return [
        name,
        f"{found['posed']} of {found['frames']}",
        f"{found['ate']:.4f}" if has_truth else "",
        f"{found['ate'] / found['extent']:.2%}" if has_truth else "",
        str(found["keyframes"]),
        *(_time(record, found[figure]) for figure in ("cpu_s", "ms_median", "ms_p95")),
        record["commit"][:7] + (" and changes" if record.get("is_changed") else ""),
        f"`{found['trajectory'][:8]}`",
    ]


def _time(record: Record, value: float) -> str:
    return f"{value:.1f}" if is_quiet(record) else f"({value:.1f})"


def write(history: list[Record], docs: Path = DOCS) -> None:
    """The picture and the page."""
    drawn = history[-NEWEST:]
    if drawn:
        draw(drawn, docs / "images" / "history.png")
    (docs / "history.md").write_text(page(history), encoding="utf-8")


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--history", type=Path, default=HISTORY)
    write(read_history(parser.parse_args().history))


if __name__ == "__main__":
    main()
