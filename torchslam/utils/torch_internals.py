"""Names that torch keeps private and torchslam needs: the one module to mend where a version of torch moves them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch._C import _are_functorch_transforms_active as in_transform
from torch._C import _is_any_autocast_enabled as is_any_autocast_enabled
from torch._C._functorch import TransformType, get_interpreter_stack
from torch._C._functorch import is_functorch_wrapped_tensor as is_transformed
from torch.autograd import forward_ad
from torch.utils import _pytree
from torch.utils.data._utils.collate import default_collate_fn_map

__all__ = [
    "default_collate_fn_map",
    "forward_mode_depth",
    "has_tangent",
    "in_forward_mode",
    "in_transform",
    "int8_matmul",
    "is_any_autocast_enabled",
    "is_transformed",
    "register_pytree",
]

T = TypeVar("T")

int8_matmul: Callable[..., Tensor] | None = getattr(torch, "_int_mm", None)
"""Product of int8 matrices as int32; None where this build of torch has none."""


def in_forward_mode() -> bool:
    """Test whether a level of `torch.autograd.forward_ad` is open."""
    return forward_ad._current_level >= 0


def has_tangent(tensor: Tensor) -> bool:
    """Test whether a tensor has a tangent of `torch.autograd.forward_ad`."""
    return in_forward_mode() and forward_ad.unpack_dual(tensor).tangent is not None


def forward_mode_depth() -> int:
    """How many transforms of `torch.func` around the call are forward mode."""
    stack = (get_interpreter_stack() or ()) if in_transform() else ()
    return sum(transform.key() == TransformType.Jvp for transform in stack)


def register_pytree(
    kind: type[T],
    leaf: str,
    flatten: Callable[[T], tuple[list[Any], Any]],
    unflatten: Callable[[Iterable[Any], Any], T],
) -> None:
    """Make a class a pytree with one leaf, which is the attribute of this name.

    `flatten` and `unflatten` convert an object to ([leaf], structure) and back; the leaf may be anything.
    """

    def flatten_with_keys(value: T) -> tuple[list[tuple[_pytree.KeyEntry, Any]], Any]:
        leaves, structure = flatten(value)
        return [(_pytree.GetAttrKey(leaf), each) for each in leaves], structure

    _pytree.register_pytree_node(kind, flatten, unflatten, flatten_with_keys_fn=flatten_with_keys)
