"""Dense reconstruction of a run: from its map and its images to depth maps and one cloud."""

from torchslam.densify.passes import DenseSummary, densify
from torchslam.densify.views import Views

__all__ = ["DenseSummary", "Views", "densify"]
