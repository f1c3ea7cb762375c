"""A simulated accelerator: a device "sim" that computes on the CPU and mixes with CPU tensors as little as CUDA does.

What runs on it finds its devices in its inputs; what only seems to, because CPU tensors meet CPU tensors, fails. Needs
no GPU. Built on torch's slot for devices written in Python, so it is for tests alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

aten = torch.ops.aten
# Operators that take tensors of several devices, on CUDA too.
COPIES = {aten.copy_.default, aten._to_copy.default}
INDEXED = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._unsafe_index.Tensor}


@functools.cache
def register() -> bool:
    """Make the name "sim" known to torch, once per process; False where this torch cannot."""
    try:
        from torch.utils.backend_registration import _setup_privateuseone_for_python_backend
    except ImportError:
        return False
    _setup_privateuseone_for_python_backend("sim")
    # Lists as indices become tensors behind the back of the dispatcher.
    _library.impl("empty_strided", _empty_strided, "PrivateUse1")
    _library.impl("_copy_from", _copy_from, "PrivateUse1")
    return True


_library = torch.library.Library("aten", "IMPL")


def _empty_strided(size: Any, stride: Any, dtype: torch.dtype | None = None, **_: Any) -> Tensor:
    return SimulatedTensor(torch.empty_strided(size, stride, dtype=dtype))


def _copy_from(source: Tensor, target: Tensor, non_blocking: bool = False) -> Tensor:
    _inner(target).copy_(_inner(source))
    return target


class SimulatedTensor(Tensor):
    """A tensor that says it is on "sim"; `inner` holds its values on the CPU."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> SimulatedTensor:
        made = Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            layout=inner.layout,
            device=torch.device("sim:0"),
            requires_grad=inner.requires_grad,
        )
        made.inner = inner
        return made

    def __repr__(self) -> str:  # type: ignore[override]
        return f"SimulatedTensor({self.inner})"

    def tolist(self) -> Any:
        return self.inner.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})


class _Simulated(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})


@contextmanager
def simulated_accelerator() -> Iterator[torch.device]:
    """Within it the device "sim" exists."""
    with _Simulated():
        yield torch.device("sim:0")


def _compute(func: Any, args: Any, kwargs: Any) -> Any:
    if not torch.is_inference_mode_enabled():
        return _compute_primitive(func, args, kwargs)
    # In inference mode composite operators arrive whole, and tensors cannot be wrapped.
    with torch.inference_mode(mode=False), _Simulated():
        parts = func.decompose(*args, **kwargs)
    if parts is not NotImplemented:
        return parts
    with torch.inference_mode(mode=False):
        return _compute_primitive(func, args, kwargs)


def _compute_primitive(func: Any, args: Any, kwargs: Any) -> Any:
    given = list(_tensors((args, kwargs)))
    _check_devices(func, args, kwargs, given)
    device = kwargs.get("device")
    if device is None:
        on_sim = any(isinstance(tensor, SimulatedTensor) for tensor in given)
    else:
        on_sim = torch.device(device).type == "sim"
        kwargs = {**kwargs, "device": torch.device("cpu")}
    result = func(*_mapped(_inner, args), **_mapped(_inner, kwargs))
    # What an operator changed in place stays the tensor that it was.
    known = {id(_inner(tensor)): tensor for tensor in given}
    if not on_sim:
        return _mapped(lambda leaf: known.get(id(leaf), leaf), result)
    return _mapped(lambda leaf: known[id(leaf)] if id(leaf) in known else SimulatedTensor(leaf), result)


def _mapped(function: Callable[[Tensor], Tensor], tree: Any) -> Any:
    """Nested arguments or results with another tensor for each. `pytree` would take most of the time."""
    if isinstance(tree, Tensor):
        return function(tree)
    if isinstance(tree, dict):
        return {key: _mapped(function, value) for key, value in tree.items()}
    if isinstance(tree, (tuple, list)):
        return type(tree)(_mapped(function, value) for value in tree)
    return tree


def _tensors(tree: Any) -> Iterator[Tensor]:
    if isinstance(tree, Tensor):
        yield tree
    elif isinstance(tree, dict):
        for value in tree.values():
            yield from _tensors(value)
    elif isinstance(tree, (tuple, list)):
        for value in tree:
            yield from _tensors(value)


def _inner(tensor: Tensor) -> Tensor:
    return tensor.inner if isinstance(tensor, SimulatedTensor) else tensor


def _check_devices(func: Any, args: Any, kwargs: Any, tensors: list[Tensor]) -> None:
    """Raise RuntimeError where CUDA would: tensors of two devices in one operator, but for numbers and indices."""
    if kwargs.get("generator") is not None and torch.device(kwargs.get("device") or "cpu").type == "sim":
        raise RuntimeError(f"{func}: a generator of the CPU for a tensor on sim")
    is_there = [isinstance(tensor, SimulatedTensor) for tensor in tensors]
    if func in COPIES or all(is_there) or not any(is_there):
        return
    indexed = func in INDEXED
    if indexed:
        if not isinstance(args[0], SimulatedTensor):
            raise RuntimeError(f"{func}: indices or values on sim for a tensor on the CPU")
        tensors = list(_tensors(args[2:]))
    allows_numbers = indexed or func is aten.fill_.Tensor or torch.Tag.pointwise in func.tags
    for tensor in tensors:
        if not isinstance(tensor, SimulatedTensor) and not (allows_numbers and tensor.ndim == 0):
            raise RuntimeError(f"{func}: a CPU tensor of shape {tuple(tensor.shape)} meets tensors on sim")
