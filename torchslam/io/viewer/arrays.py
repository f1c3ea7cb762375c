"""Arrays in the data of view.html."""

from __future__ import annotations

import base64
import sys
from typing import Any

import numpy as np
from jaxtyping import Num, Shaped
from torch import Tensor


def encoded(values: Num[Tensor, "*shape"] | np.ndarray | list[Any], kind: str) -> dict[str, str]:
    """Encode numbers as base64 of their little-endian bytes, row by row."""
    array = np.ascontiguousarray(np.asarray(values, dtype=kind))
    if sys.byteorder == "big":
        array = array.byteswap()
    return {"type": kind, "data": base64.b64encode(array.tobytes()).decode("ascii")}


def decoded(packed: dict[str, str]) -> Shaped[np.ndarray, " N"]:
    """Decode the result of `encoded` to a flat array."""
    kind = np.dtype(packed["type"]).newbyteorder("<")
    return np.frombuffer(base64.b64decode(packed["data"]), kind)
