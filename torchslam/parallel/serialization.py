"""Serialization of frames and features to dictionaries of NumPy arrays: tensors are slow to pickle."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchslam.types import Features, Frame

Arrays = dict[str, Any]


def pack_features(features: Features | None) -> Arrays | None:
    """The fields of features as arrays."""
    if features is None:
        return None
    columns = {each.name: getattr(features, each.name) for each in fields(features)}
    return {
        name: column.numpy() if isinstance(column, Tensor) else column for name, column in columns.items()
    }


def unpack_features(arrays: Arrays | None) -> Features | None:
    """The features that `pack_features` packed."""
    if arrays is None:
        return None
    columns: dict[str, Any] = {
        name: torch.from_numpy(each) if isinstance(each, np.ndarray) else each
        for name, each in arrays.items()
    }
    return Features(**columns)


def pack_frame(frame: Frame, features: Features | None) -> Arrays:
    """A frame without its image."""
    truth = None if frame.T_cw_groundtruth is None else frame.T_cw_groundtruth.numpy()
    return {
        "index": frame.index,
        "timestamp": frame.timestamp,
        "name": frame.name,
        "truth": truth,
        "features": pack_features(features),
    }


def unpack_frame(arrays: Arrays) -> Frame:
    """The frame that `pack_frame` packed, with an empty image."""
    truth = arrays["truth"]
    return Frame(
        arrays["index"],
        arrays["timestamp"],
        torch.zeros(1, 1, 0, 0),
        arrays["name"],
        None if truth is None else torch.from_numpy(truth),
        features=unpack_features(arrays["features"]),
    )
