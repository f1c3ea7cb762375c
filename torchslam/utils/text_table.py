"""What every command prints its figures with; without torch, which takes seconds to import."""

from __future__ import annotations

from collections.abc import Mapping


def table(rows: Mapping[str, str]) -> str:
    """Two columns: label and value."""
    width = max(map(len, rows), default=0)
    return "\n".join(f"  {label:<{width}}   {value}" for label, value in rows.items())
