"""Plots of one run or of a batch: functions of plain values that return a matplotlib figure; `save` writes it."""

from torchslam.io.plots.charts import plot_batch, plot_errors, plot_stage_times, plot_tracking
from torchslam.io.plots.scene import plot_features, plot_scene, plot_top_view
from torchslam.io.plots.style import png, save

__all__ = [
    "plot_batch",
    "plot_errors",
    "plot_features",
    "plot_scene",
    "plot_stage_times",
    "plot_top_view",
    "plot_tracking",
    "png",
    "save",
]
