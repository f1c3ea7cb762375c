"""Monocular visual SLAM as a PyTorch program."""

__version__ = "0.1.0"
