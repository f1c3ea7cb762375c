"""Plots of one run: functions of plain values that return a matplotlib figure; `save` writes it."""

from torchslam.io.plots.charts import plot_errors, plot_tracking
from torchslam.io.plots.scene import plot_features, plot_scene, plot_top_view
from torchslam.io.plots.style import save

__all__ = [
    "plot_errors",
    "plot_features",
    "plot_scene",
    "plot_top_view",
    "plot_tracking",
    "save",
]
