"""Rendered sequences with exact ground truth: `synthetic:room` and its relatives."""

from __future__ import annotations

from torchslam.data.synthetic.sequence import SyntheticSequence, is_synthetic, open_synthetic

__all__ = ["SyntheticSequence", "is_synthetic", "open_synthetic"]
