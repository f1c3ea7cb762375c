"""The robust kernels, which `torchslam.geometry.robust` defines."""

from torchslam.geometry.robust import Kernel, Robustified, robustify

__all__ = ["Kernel", "Robustified", "robustify"]
