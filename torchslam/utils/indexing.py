"""Sets of whole numbers, such as the rows of points and keyframes, by a flag for each from the lowest to the highest.

Several times as fast as sorting, as `torch.unique` and `torch.isin` do, where the numbers are as dense as rows are.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def true_indices(mask: Tensor) -> Tensor:
    """Positions (K,) int64 where a flat boolean mask is true, ascending."""
    if mask.is_cpu:  # where few are true numpy takes half the time
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero().squeeze(1)


def distinct(ids: Tensor) -> Tensor:
    """(m,) the distinct ones of ids (n,), ascending: `torch.unique`."""
    if len(ids) == 0:
        return ids
    low, flags = _flags(ids)
    return true_indices(flags) + low


def ranks_among(ids: Tensor, ascending: Tensor) -> Tensor:
    """(n,) where each of ids (n,) stands among distinct ones (m,), ascending, which hold them all."""
    if len(ids) == 0:
        return ids
    low, high = int(ascending[0]), int(ascending[-1])
    ranks = ids.new_empty(high - low + 1)
    ranks[ascending - low] = torch.arange(len(ascending), device=ids.device)
    return ranks.index_select(0, ids - low)


def is_among(ids: Tensor, others: Tensor) -> Tensor:
    """(n,) bool, whether each of ids (n,) is one of others (m,): `torch.isin`."""
    if len(ids) == 0 or len(others) == 0:
        return torch.zeros_like(ids, dtype=torch.bool)
    low, flags = _flags(others)
    at = ids - low
    is_within = (at >= 0) & (at < len(flags))
    return flags.index_select(0, at.clamp_(0, len(flags) - 1)) & is_within


def _flags(ids: Tensor) -> tuple[int, Tensor]:
    """The lowest of ids (n,), and for each number from there on whether it is one of them."""
    low, high = (int(end) for end in ids.aminmax())
    flags = torch.zeros(high - low + 1, dtype=torch.bool, device=ids.device)
    return low, flags.index_fill_(0, ids - low, True)
