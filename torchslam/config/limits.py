"""Upper bounds shared by the settings of all sections."""

from __future__ import annotations

MAX_COUNT = 1_000_000
"""Upper bound of every count: frames, keyframes, points or matches."""
MAX_LENGTH_PX = 10_000
"""Upper bound of every length in the image; no image is larger."""
MAX_FACTOR = 1_000_000
"""Upper bound of ratios and factors without a natural limit; far beyond the value that disables a test."""
