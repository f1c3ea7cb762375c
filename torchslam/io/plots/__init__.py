"""Plots of one run or of a batch: functions of plain values that return a matplotlib figure; `save` writes it."""

from torchslam.io.plots.batch import plot_batch
from torchslam.io.plots.image import plot_features
from torchslam.io.plots.scene import plot_scene, plot_top_view
from torchslam.io.plots.style import png, save
from torchslam.io.plots.timeline import plot_errors, plot_stage_times, plot_tracking

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
