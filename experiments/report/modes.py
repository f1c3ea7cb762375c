"""Draw the modes of a session and the transitions between them for docs/tracking_modes.md.

    python -m experiments.report.modes

Writes docs/images/tracking_modes.svg. The numbers of the arrows are the rows of the table that it prints.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.common import parser_of, table
from experiments.report.record import ROOT
from torchslam.io.plots.charts import (
    GROUND_TRUTH,
    MUTED,
    SHADES,
    house_style,
    new_figure,
)
from torchslam.system.modes import TRANSITIONS, Mode
from torchslam.types import State

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import FancyBboxPatch, Patch

PICTURE = ROOT / "docs" / "images" / "tracking_modes.svg"
PLACES = {
    Mode.INITIALIZING: (-0.3, 2.0),
    Mode.PROVISIONAL: (2.3, 2.0),
    Mode.TRACKING: (7.5, 2.0),
    Mode.PROVISIONAL_DOUBTED: (2.3, 1.0),
    Mode.DOUBTED: (7.5, 1.0),
    Mode.LOST: (4.9, 0.0),
    Mode.RELOCALIZED: (10.1, 0.0),
}
"""Where each mode is drawn."""
TRACKED = "#dbe7ef"
COLORS = {
    State.INITIALIZING: SHADES[State.INITIALIZING][0],
    State.LOST: SHADES[State.LOST][0],
    State.TRACKING: TRACKED,
    State.UNCERTAIN: SHADES[State.UNCERTAIN][0],
}
BEND = 0.08  # of an arrow, as a ratio of its length: two modes may lead to each other
LABEL_AT = 0.3  # of the way along an arrow
BOX = (0.86, 0.19)  # half of its width and height


def draw_modes(path: Path) -> None:
    """A box per mode in the color of the state that users see, an arrow per transition; `id`s name both modes."""
    with house_style():
        import matplotlib

        figure = new_figure(9.6, 4.4)
        axes = figure.add_subplot()
        axes.set_xlim(-1.2, 11.0)
        axes.set_ylim(-0.3, 2.3)
        axes.set_axis_off()
        boxes = {mode: axes.add_patch(_box(mode)) for mode in PLACES}
        for mode, (x, y) in PLACES.items():
            axes.text(
                x, y, f"{mode.name}\n{mode.state.value}", ha="center", va="center", fontsize=7.5, zorder=3
            )
        for number, (before, after) in enumerate(TRANSITIONS, start=1):
            _arrow(axes, number, boxes, before, after)
        path.parent.mkdir(parents=True, exist_ok=True)
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "modes"}):
            figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})


def _box(mode: Mode) -> FancyBboxPatch:
    from matplotlib.patches import FancyBboxPatch

    (x, y), (width, height) = PLACES[mode], BOX
    return FancyBboxPatch(
        (x - width, y - height),
        2 * width,
        2 * height,
        boxstyle="round,pad=0,rounding_size=0.08",
        facecolor=COLORS[mode.state],
        edgecolor=MUTED,
        gid=mode.name,
        zorder=2,
    )


def _arrow(axes: Axes, number: int, boxes: dict[Mode, Patch], before: Mode, after: Mode) -> None:
    """An arrow that bends to its left, and its number on it."""
    from matplotlib.patches import FancyArrowPatch

    arrow = FancyArrowPatch(
        PLACES[before],
        PLACES[after],
        connectionstyle=f"arc3,rad={-BEND}",
        arrowstyle="-|>",
        mutation_scale=11,
        color=MUTED,
        linewidth=0.9,
        patchA=boxes[before],
        patchB=boxes[after],
        gid=f"{before.name}-{after.name}",
        zorder=1,
    )
    axes.add_patch(arrow)
    curve = np.asarray(arrow.get_path().vertices, dtype=np.float64)[:3]  # control points, from box to box
    weights = np.array([(1 - LABEL_AT) ** 2, 2 * LABEL_AT * (1 - LABEL_AT), LABEL_AT**2])
    x, y = (weights @ curve).tolist()
    label = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": "none"}
    axes.text(
        x, y, str(number), ha="center", va="center", color=GROUND_TRUTH, fontsize=8, bbox=label, zorder=4
    )


def rows() -> str:
    """The table of the transitions, numbered as in the picture."""
    return table(
        ["number", "from", "to", "with this frame"],
        [
            [str(number), f"`{before.name}`", f"`{after.name}`", why]
            for number, ((before, after), why) in enumerate(TRANSITIONS.items(), start=1)
        ],
    )


def main() -> None:
    parser_of(__doc__).parse_args()
    draw_modes(PICTURE)
    print(rows())


if __name__ == "__main__":
    main()
