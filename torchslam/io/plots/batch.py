"""Plot of a batch: ratio of posed frames and relative error of every sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from torchslam.io.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMED = 40
"""Rows that are shown by name; of more, their distribution."""


def plot_batch(
    names: Sequence[str],
    statuses: Sequence[str],
    posed: Sequence[float | None],
    errors: Sequence[float | None],
    title: str = "",
) -> Figure:
    """Plot posed fraction and relative error per sequence: by name, or sorted if there are more than `NAMED`.

    Args:
        statuses: "done", or the text to show instead of a bar
        posed: fraction of the frames that have a pose
        errors: ATE as a fraction of the path; None: unknown
    """
    with style.house_style():
        few = len(names) <= NAMED
        figure = style.new_figure(9.0, 1.3 + 0.24 * len(names) if few else 4.0)
        left, right = figure.subplots(1, 2, sharey=few)
        if few:
            _by_name(left, right, names, statuses, posed, errors)
        else:
            _sorted(left, [100.0 * (share or 0.0) for share in posed])
            _sorted(right, [100.0 * error for error in errors if error is not None])
        left.set(xlabel="posed frames (%)", xlim=(0.0, 103.0))
        right.set(xlabel="ATE (% of the path)", xscale="log", xlim=_decades(errors))
        right.xaxis.set_major_formatter(lambda value, position: f"{value:g}")
        figure.suptitle(title, x=0.01, ha="left", fontsize=10.0)
    return figure


def _by_name(
    left: Axes,
    right: Axes,
    names: Sequence[str],
    statuses: Sequence[str],
    posed: Sequence[float | None],
    errors: Sequence[float | None],
) -> None:
    """A row for each sequence, the first one at the top."""
    rows = np.arange(len(names))
    shares = np.array([100.0 * (share or 0.0) for share in posed])
    left.barh(rows, shares, color=style.ESTIMATE, height=0.62)
    left.set_yticks(rows, [name if len(name) <= 40 else name[:38] + "…" for name in names])
    left.set_ylim(len(names) - 0.4, -0.6)
    left.grid(axis="y", visible=False)
    for row, status in enumerate(statuses):
        if status != "done":
            left.annotate(
                status, (0.0, row), (4, 0), textcoords="offset points", va="center", color=style.ACCENT
            )
    known = np.array([error is not None and error > 0 for error in errors], dtype=bool)
    percent = np.array([100.0 * (error or 0.0) for error in errors])
    right.plot(percent[known], rows[known], "o", ms=5.0, color=style.ACCENT)
    for row in rows[known]:
        label = f"{percent[row]:.2g}"
        right.annotate(
            label, (percent[row], row), (6, 0), textcoords="offset points", va="center", fontsize=8
        )


def _sorted(axes: Axes, values: Sequence[float]) -> None:
    """For each value the share of the sequences that have at most this."""
    ordered = np.sort(np.array(values, dtype=float))
    axes.step(ordered, 100.0 * np.arange(1, len(ordered) + 1) / max(len(ordered), 1), color=style.ESTIMATE)
    axes.set(ylabel=f"of {len(ordered)} sequences (%)", ylim=(0.0, 103.0))


def _decades(errors: Sequence[float | None]) -> tuple[float, float]:
    """Powers of ten around the errors, in percent."""
    exponents = [np.log10(100.0 * error) for error in errors if error is not None and error > 0]
    low, high = np.floor(min(exponents, default=0.0)), np.ceil(max(exponents, default=0.0))
    return 10.0**low, 10.0 ** max(high, low + 1)
