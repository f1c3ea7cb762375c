"""CPU time and memory that this process and its ended workers used."""

from __future__ import annotations

import sys

_KIB_PER_MB, _BYTES_PER_MB = 1e6 / 1024, 1e6  # Linux counts in KiB, macOS in bytes


def cpu_seconds() -> float | None:
    """User and system time of this process and of its children that have ended; None where the system has no count."""
    if sys.platform == "win32":
        return None
    import resource

    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in used)


def peak_memory_mb() -> float | None:
    """The largest resident set of this process or of any one child that has ended; None where it is not counted."""
    if sys.platform == "win32":
        return None
    import resource

    per_mb = _BYTES_PER_MB if sys.platform == "darwin" else _KIB_PER_MB
    peaks = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return max(peaks) / per_mb
