"""Covariances as ellipses, a number of standard deviations wide."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIGMAS = 3.0
_SIZE = 0.06  # of the largest ellipse in the picture, when magnified


def draw_ellipses(
    axes: Axes,
    centers: np.ndarray,
    covariances: np.ndarray,
    what: str,
    color: str,
    magnified_in: float = 0.0,
    linewidth: float = 0.9,
    zorder: float = 5,
) -> None:
    """Draw covariances (L, 2, 2) around centers (L, 2), say in the legend what they are; none where all are zero.

    magnified_in: the width of the picture, in which to magnify by the power of ten that keeps ellipses small; 0: not
    """
    from matplotlib.collections import EllipseCollection

    variances, directions = np.linalg.eigh(covariances)
    radii = SIGMAS * np.sqrt(variances.clip(min=0.0))
    known = radii[:, 1] > 0
    if not known.any():
        return
    radii, directions = radii[known], directions[known]
    largest = max(1.0, _SIZE * magnified_in / radii.max())
    magnification = 10.0 ** int(np.floor(np.log10(largest)))
    diameters = 2 * magnification * radii
    label = f"{what}, {SIGMAS:g} sigma" + (f" x {magnification:g}" if magnification > 1.0 else "")
    ellipses = EllipseCollection(
        diameters[:, 1],
        diameters[:, 0],
        np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1])),
        units="xy",
        offsets=centers[known],
        offset_transform=axes.transData,
        facecolors="none",
        edgecolors=color,
        linewidths=linewidth,
        zorder=zorder,
    )
    axes.add_collection(ellipses)
    # A legend cannot show a collection of ellipses.
    axes.plot([], [], "o", ms=8, mfc="none", mec=color, mew=linewidth, label=label)
