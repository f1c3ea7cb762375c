"""Pictures of a run. Every function takes plain tensors and returns a matplotlib figure; `save` writes it."""

from torchslam.output.plots.image import plot_features
from torchslam.output.plots.scene import plot_scene, plot_top_view
from torchslam.output.plots.style import save
from torchslam.output.plots.timeline import plot_errors, plot_stage_times, plot_tracking

__all__ = [
    "plot_errors",
    "plot_features",
    "plot_scene",
    "plot_stage_times",
    "plot_top_view",
    "plot_tracking",
    "save",
]
