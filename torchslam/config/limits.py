"""The largest numbers that make sense in any section."""

from __future__ import annotations

MOST = 1_000_000
"""Of anything that is counted: more frames, keyframes or matches than that are none."""
LONGEST_PX = 10_000
"""Of a length in the image: no image is larger."""
LARGEST = 1_000_000
"""Of shares and factors that have no end of their own: far beyond what switches a test off."""
