"""How far off keypoints are, by what they show: a panel for each cue, a line for each sequence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import matplotlib
import torch
from torch import Tensor

from experiments.noise_model.cues import NAMES
from experiments.noise_model.graphs import Example
from experiments.noise_model.training import Residuals, residuals, solved

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PARTS = 6
MEDIAN = 2 * math.log(2)  # of a chi-square distribution of two degrees of freedom


def by_parts(found: Residuals, cue: int) -> tuple[Tensor, Tensor]:
    """(PARTS,) medians of a cue in equal parts of the observations, and the noise there in scales.

    By the median of the squared errors, which outliers do not move.
    """
    order = torch.argsort(found.values[:, cue])
    parts = order.tensor_split(PARTS)
    middles = torch.stack([found.values[part, cue].median() for part in parts])
    squared = found.errors.square().sum(-1)
    return middles, torch.stack([(squared[part].median() / MEDIAN).sqrt() for part in parts])


def draw(examples: Mapping[str, Example], file: Path) -> None:
    """Of runs by the hand-set rule, whose graphs are solved first."""
    runs = {name: solved(example) for name, example in examples.items()}
    measured = {name: residuals(run, run) for name, run in runs.items()}
    figure, axes = plt.subplots(2, 5, figsize=(13, 5.2), sharey=True)
    for cue, (panel, name) in enumerate(zip(axes.flat, NAMES, strict=True)):
        for label, found in measured.items():
            panel.plot(*by_parts(found, cue), ".-", label=label.partition("?")[0], linewidth=1)
        panel.set_title(name, fontsize=10)
        panel.set_ylim(0, None)
        panel.grid(alpha=0.3)
    for panel in axes[:, 0]:
        panel.set_ylabel("noise (scales)")
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="lower center", ncol=len(measured), fontsize=9)
    figure.savefig(file, dpi=80)
    plt.close(figure)
