"""Set operations on dense row numbers, by a flag per number between the lowest and the highest; components of graphs.

For dense numbers flags are several times faster than the sorting of `torch.unique` and `torch.isin`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def true_indices(mask: Bool[Tensor, " N"]) -> Int[Tensor, " R"]:
    """Return the positions at which a flat boolean mask is true, ascending."""
    if mask.is_cpu:  # twice as fast in NumPy for sparse masks
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero().squeeze(1)


def distinct(ids: Int[Tensor, " N"]) -> Int[Tensor, " R"]:
    """Return the distinct values of ids, ascending, as `torch.unique`."""
    if len(ids) == 0:
        return ids
    low, flags = _flags(ids)
    return true_indices(flags) + low


def between_rows(
    ascending: Float[Tensor, " M"], values: Float[Tensor, "*shape"]
) -> tuple[Int[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """Return the row before each value, and how far the value is from there to the next row, 0 to 1.

    Beyond the ends it is the first or the last interval, and the share is below 0 or above 1. Differentiable.
    `ascending` are two or more distinct numbers, such as times.
    """
    found = torch.searchsorted(ascending.detach().contiguous(), values.detach().contiguous(), right=True)
    left = found.clamp(1, len(ascending) - 1) - 1
    return left, (values - ascending[left]) / (ascending[left + 1] - ascending[left])


def ranks_among(ids: Int[Tensor, " N"], ascending: Int[Tensor, " M"]) -> Int[Tensor, " N"]:
    """Return the position of each id in distinct ascending ids that contain all of them."""
    if len(ids) == 0:
        return ids
    low, high = int(ascending[0]), int(ascending[-1])
    ranks = ids.new_empty(high - low + 1)
    ranks[ascending - low] = torch.arange(len(ascending), device=ids.device)
    return ranks.index_select(0, ids - low)


def is_among(ids: Int[Tensor, " N"], others: Int[Tensor, " M"]) -> Bool[Tensor, " N"]:
    """Return the membership of each id in others, as `torch.isin`."""
    if len(ids) == 0 or len(others) == 0:
        return torch.zeros_like(ids, dtype=torch.bool)
    low, flags = _flags(others)
    at = ids - low
    is_within = (at >= 0) & (at < len(flags))
    return flags.index_select(0, at.clamp_(0, len(flags) - 1)) & is_within


def connected_parts(
    edges: Int[Tensor, "E 2"], count: int, counted: Bool[Tensor, "*batch E"] | None = None
) -> Int[Tensor, "*batch {count}"]:
    """Return the lowest node of the connected component of each of `count` nodes, by the counted edges, or all.

    Every node points to one of its component with a number not above its own; edges hook these onto one another, and
    pointers are shortened, until nothing changes: about log(count) rounds.
    """
    if counted is None:
        counted = edges.new_ones(len(edges), dtype=torch.bool)
    label = torch.arange(count, device=edges.device).expand(*counted.shape[:-1], count)
    ends = edges.T.flatten()
    while True:
        at_ends = label[..., ends]
        low = torch.minimum(*at_ends.chunk(2, dim=-1))
        low = torch.cat([torch.where(counted, low, count)] * 2, dim=-1)
        hooked = label.scatter_reduce(-1, at_ends, low, "amin")
        hooked = hooked.scatter_reduce(-1, ends.expand_as(low), low, "amin")
        shortened = hooked.gather(-1, hooked)
        if torch.equal(shortened, label):
            return label
        label = shortened


def row_mask(name: str, rows: Tensor | Sequence[int] | None, like: Tensor) -> Tensor:
    """Return a bool mask of the shape (B, N) of `like`; `rows` are a mask, (N,) or (B, N), or indices.

    Raises:
        ValueError: They are neither, or rows are out of range or named twice, as in a mask of ones and zeros.
    """
    batch, count = like.shape
    rows = torch.as_tensor(() if rows is None else rows, device=like.device)
    if rows.dtype == torch.bool:
        if rows.shape not in ((count,), (1, count), (batch, count)):
            raise ValueError(f"{name} as a mask must have shape ({count},), not {tuple(rows.shape)}")
        return rows.expand(batch, count)
    rows = row_numbers(name, rows, count)
    mask = torch.zeros(count, dtype=torch.bool, device=like.device).index_fill_(0, rows, True)
    if int(mask.sum()) < len(rows):
        raise ValueError(f"{name} names a row twice: row numbers differ, and a mask must be bool")
    return mask.expand(batch, count)


def row_numbers(name: str, rows: Tensor, count: int) -> Int[Tensor, " M"]:
    """Return the row numbers of a table of `count` rows that numbers or a mask name; negative ones count from its end.

    Raises:
        ValueError: They are of another kind or shape, or out of range.
    """
    if rows.numel() == 0:
        return rows.long()  # an empty tuple has no kind
    if rows.dtype == torch.bool and rows.shape == (count,):
        return rows.nonzero().flatten()
    if rows.dtype not in (torch.int32, torch.int64) or rows.ndim != 1:
        raise ValueError(
            f"{name} must be a mask of bool, or row numbers (n,), int64, not {rows.dtype} {tuple(rows.shape)}"
        )
    if not -count <= int(rows.min()) <= int(rows.max()) < count:
        raise ValueError(f"{name} must lie in 0 ... {count - 1}")
    return torch.where(rows < 0, rows + count, rows).long()


def _flags(ids: Int[Tensor, " N"]) -> tuple[int, Bool[Tensor, " R"]]:
    """Return the lowest of ids and a flag for each number from there on."""
    low, high = (int(end) for end in ids.aminmax())
    flags = torch.zeros(high - low + 1, dtype=torch.bool, device=ids.device)
    return low, flags.index_fill_(0, ids - low, True)
