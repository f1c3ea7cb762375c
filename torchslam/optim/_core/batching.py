"""Trees of batched tensors, and rules by which a function of batches supports `torch.func.vmap`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.func import vmap
from torch.utils._pytree import tree_map

Tensors = tuple[Tensor, ...]
InDims = Sequence[int | None]
"""The mapped dimension of each tensor; None where all elements share the tensor."""

Tree = TypeVar("Tree")
"""Nested named tuples of batched tensors."""


def index_tree(tree: Tree, rows: Tensor) -> Tree:
    """Select elements of a batch by their rows (b,)."""
    return tree_map(lambda tensor: tensor.index_select(0, rows), tree)


def where_tree(first: Tensor, one: Tree, other: Tree) -> Tree:
    """Select per element: `one` where `first` (B,) is true, `other` elsewhere."""

    def choose(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(first.view(-1, *(1,) * (a.ndim - 1)), a, b)

    return tree_map(choose, one, other)


def concat_tree(trees: Sequence[Tree], rows: Sequence[Tensor]) -> Tree:
    """Merge trees into one batch; each has the elements of its rows (b,)."""
    order = torch.argsort(torch.cat(list(rows)))
    return tree_map(lambda *parts: torch.cat(parts).index_select(0, order), *trees)


def nested_vmap(function: Callable[[Any], Any], many: int) -> Callable[[Any], Any]:
    """Map a function over `many` additional leading dimensions of its tensors."""
    for _ in range(many):
        function = vmap(function)
    return function


def leading(tensor: Tensor, dim: int | None, size: int) -> Tensor:
    """Move the mapped dimension to the front, or expand a shared tensor."""
    return tensor.expand(size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)


def vmap_by_loop(
    function: Callable[..., Tensors], size: int, dims: InDims, tensors: Sequence[Tensor]
) -> Tensors:
    """Apply the function to one element after the other."""
    elements = [
        function(*(x if dim is None else x.select(dim, row) for x, dim in zip(tensors, dims, strict=True)))
        for row in range(size)
    ]
    return tuple(torch.stack(parts) for parts in zip(*elements, strict=True))


def vmap_by_fold(
    function: Callable[..., Tensors],
    size: int,
    dims: InDims,
    tensors: Sequence[Tensor],
    ndims: Sequence[int],
    before: Sequence[int],
) -> Tensors:
    """Fold the mapped dimension into the batch dimension of the function, which follows `before` dimensions."""
    batched = [
        x.ndim - (dim is not None) > ndim + skip
        for x, dim, ndim, skip in zip(tensors, dims, ndims, before, strict=True)
    ]
    batch = next(
        x.shape[skip + (dim is not None and dim <= skip)]
        for x, dim, skip, has in zip(tensors, dims, before, batched, strict=True)
        if has
    )
    rows = []
    for x, dim, skip, has in zip(tensors, dims, before, batched, strict=True):
        if dim is None and not has:
            rows.append(x)
            continue
        x = leading(x, dim, size).movedim(0, skip)
        if not has:
            x = x.unsqueeze(skip + 1).expand(*x.shape[: skip + 1], batch, *x.shape[skip + 1 :])
        rows.append(x.flatten(skip, skip + 1))
    skip = before[0]
    return tuple(part.unflatten(skip, (size, batch)) for part in function(*rows))
