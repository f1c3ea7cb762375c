"""Loop closing: keyframe database, loop detection, Sim(3) between keyframes, drift correction, map merging."""

from __future__ import annotations

from torchslam.loop_closing.keyframe_database import KeyframeDatabase

__all__ = ["KeyframeDatabase"]
