"""Cumulative error curves, one panel per unseen part."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import torch

from experiments.match_weights.report import PartResult

_COLOURS = {
    "uniform weights": "#9e9e9e",
    "best kernel": "#4c78a8",
    "RANSAC": "#54a24b",
    "by hand": "#b79a20",
    "learned": "#d62728",
}


def draw(path: Path, parts: dict[str, PartResult]) -> None:
    """Draw the share of problems whose position error is below x; of several seeds the first.

    The axis ends where nine in ten of the first method's errors do.
    """
    figure, axes = plt.subplots(
        1, len(parts), figsize=(3.0 * len(parts), 2.9), sharey=True, layout="constrained"
    )
    for axis, (name, part) in zip(axes, parts.items(), strict=True):
        for label, colour in _COLOURS.items():
            centimetres = 100 * part.errors[label][0, :, 0].sort().values
            share = torch.arange(1, len(centimetres) + 1) / len(centimetres)
            width = 1.8 if label == "learned" else 1.1
            axis.step(centimetres, share, where="post", label=label, color=colour, linewidth=width)
            if label == next(iter(_COLOURS)):
                axis.set_xlim(0, float(centimetres.quantile(0.9)))
        axis.axhline(0.5, color="0.85", linewidth=0.8, zorder=0)
        axis.set(title=f"{name} ({len(part.problems)})", xlabel="position error (cm)", ylim=(0, 1))
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("share of problems")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    figure.savefig(path, dpi=80)
    plt.close(figure)
