"""Geometry is computed in the precision of its inputs: no autocast inside, no half precision, no mixture."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

from torchslam.geometry.signatures import check_arguments, following
from torchslam.utils.torch_internals import is_any_autocast_enabled

P = ParamSpec("P")
R = TypeVar("R")

_DEVICE_TYPES = ("cpu", "cuda", "mps", "xpu")
_DTYPES = (torch.float32, torch.float64)


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with the same bits under `torch.autocast` as without, for tensors that its signature allows.

    Autocast would multiply matrices in bfloat16: rotations wrong in the third digit that look like any other. All
    tensors of floats must have one dtype, which cameras follow.
    """
    return _precise(function, one_dtype=True)


def without_autocast(function: Callable[P, R]) -> Callable[P, R]:
    """As `full_precision`, for tensors of floats that may be of several dtypes."""
    return _precise(function, one_dtype=False)


def _precise(function: Callable[P, R], one_dtype: bool) -> Callable[P, R]:
    @wraps(function)
    def precise(*args: P.args, **kwargs: P.kwargs) -> R:
        if not (torch.compiler.is_compiling() or torch.jit.is_tracing()):
            dtype = check_arguments(function, args, kwargs, one_dtype)
            if one_dtype and dtype is not None:
                args = tuple(following(value, dtype) for value in args)  # type: ignore[assignment]
                kwargs = {name: following(value, dtype) for name, value in kwargs.items()}  # type: ignore[assignment]
        if not is_any_autocast_enabled():
            return function(*args, **kwargs)
        for device_type in _DEVICE_TYPES:
            if torch.is_autocast_enabled(device_type):
                with torch.autocast(device_type, enabled=False):  # and so on with the other kinds of device
                    return precise(*args, **kwargs)
        return function(*args, **kwargs)

    return precise


def check_dtypes(**tensors: Tensor | None) -> None:
    """Raises ValueError unless all tensors are float32, or all float64; names the first that is not."""
    given = [(name, tensor.dtype) for name, tensor in tensors.items() if tensor is not None]
    first, expected = given[0]
    for name, dtype in given:
        if dtype not in _DTYPES:
            raise ValueError(f"{name} must be float32 or float64, not {dtype}")
        if dtype != expected:
            raise ValueError(f"{name} is {dtype}, but {first} is {expected}: all must be the same")


def check_positive(**numbers: float | None) -> None:
    """Raises ValueError unless all numbers that are given are above zero; names the first that is not."""
    for name, number in numbers.items():
        if number is not None and not number > 0:
            raise ValueError(f"{name} must be above zero, not {number}")
