"""Places that were seen before: which keyframes look like a frame."""

from __future__ import annotations

from torchslam.loop_closing.keyframe_database import KeyframeDatabase

__all__ = ["KeyframeDatabase"]
