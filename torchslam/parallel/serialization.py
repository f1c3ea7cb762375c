"""Frames and what is known of them as arrays, for the way between processes: tensors are slow to pickle."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchslam.types import Anchor, Features, Followed, Frame

Value = TypeVar("Value", Anchor, Followed, Features)
Arrays = dict[str, Any]


def packed(value: Value | None) -> Arrays | None:
    """The fields of a value, as arrays: tensors are slow to pickle."""
    if value is None:
        return None
    columns = {each.name: getattr(value, each.name) for each in fields(value)}
    return {
        name: column.numpy() if isinstance(column, Tensor) else column for name, column in columns.items()
    }


def unpacked(kind: type[Value], arrays: Arrays | None) -> Value | None:
    """What `packed` packed."""
    if arrays is None:
        return None
    columns: dict[str, Any] = {
        name: torch.from_numpy(each) if isinstance(each, np.ndarray) else each
        for name, each in arrays.items()
    }
    return kind(**columns)


def as_arrays(frame: Frame, followed: Followed | None, features: Features | None) -> Arrays:
    """A frame without its image."""
    truth = None if frame.T_cw_groundtruth is None else frame.T_cw_groundtruth.numpy()
    return {
        "index": frame.index,
        "timestamp": frame.timestamp,
        "name": frame.name,
        "truth": truth,
        "followed": packed(followed),
        "features": packed(features),
    }


def from_arrays(arrays: Arrays) -> Frame:
    """What `as_arrays` packed."""
    truth = arrays["truth"]
    return Frame(
        arrays["index"],
        arrays["timestamp"],
        torch.zeros(1, 1, 0, 0),
        arrays["name"],
        None if truth is None else torch.from_numpy(truth),
        features=unpacked(Features, arrays["features"]),
        followed=unpacked(Followed, arrays["followed"]),
    )
