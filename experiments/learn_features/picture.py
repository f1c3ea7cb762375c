"""The picture of the README."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import torch

from experiments.learn_features.report import Result

WINDOW = 50  # steps


def draw(path: Path, losses: list[list[float]], before: dict[str, Result], after: dict[str, Result]) -> None:
    """Left the loss of every training, right what two halves of a pair's matches disagree by, before and after."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.2), layout="constrained")
    for seed, each in enumerate(losses):
        if len(each) >= WINDOW:
            means = torch.tensor(each).unfold(0, WINDOW, 1).mean(-1)
            left.plot(range(WINDOW // 2, WINDOW // 2 + len(means)), means, label=f"seed {seed}", linewidth=1)
    left.set(
        xlabel="step", ylabel=f"loss, mean of {WINDOW} steps", title="training: error of localised views"
    )
    left.legend(frameon=False)
    for name, part in before.items():
        x, y = 1e3 * part.pairs.rotation_halves, 1e3 * after[name].pairs.rotation_halves
        right.plot(x, y, "o", markersize=3, label=name)
    right.axline((1, 1), (2, 2), color="0.7", linewidth=0.8, zorder=0)
    right.set(
        xscale="log", yscale="log", xlabel="XFeat (mrad)", ylabel="XFeat, trained (mrad)", aspect="equal"
    )
    right.set_title(
        "rotation between halves of the matches\nunseen pairs; below the line: better", fontsize=10
    )
    right.legend(frameon=False, fontsize=8)
    for axis in (left, right):
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=80)
    plt.close(figure)
