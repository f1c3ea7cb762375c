"""From a point to its observations: the table of keyframes read the other way round.

What a keyframe sees is a row of the map's table; who sees a point would be a scan of all of it. This index holds for
every point the places of that table where it stands, so that a question about some points costs what these points
cost, however large the map is. It is derived from the table: never saved, made anew where it is missing.
"""

from __future__ import annotations

import torch
from torch import Tensor

NOWHERE = -1
_LEAST_ROWS, _LEAST_WIDTH = 64, 4


class Observers:
    """For every point the places (keyframe row * N + keypoint) that see it, in rows that are filled from the left."""

    def __init__(self, table: Tensor) -> None:
        """The index of a table (K, N) of point rows, negative where a keypoint sees nothing."""
        # Half the memory of int64: enough for two million keyframes of a thousand keypoints.
        self._places = torch.full(
            (_LEAST_ROWS, _LEAST_WIDTH), NOWHERE, dtype=torch.int32, device=table.device
        )
        flat = table.flatten()
        places = torch.nonzero(flat >= 0)[:, 0]
        self.add(flat[places], places)

    def of(self, point_ids: Tensor) -> tuple[Tensor, Tensor]:
        """(o,), (o,) for every observation of points (n,) its index in 0 ... n - 1 and its place."""
        places = self.padded(point_ids)
        which, column = torch.nonzero(places >= 0, as_tuple=True)
        return which, places[which, column].long()

    def padded(self, point_ids: Tensor) -> Tensor:
        """(n, w) the places that see points (n,), in rows filled from the left, then NOWHERE."""
        self._reach(point_ids)
        return self._places[point_ids]

    def add(self, point_ids: Tensor, places: Tensor) -> None:
        """Note that points (n,) are seen at places (n,); a point may stand there several times."""
        if len(point_ids) == 0:
            return
        self._reach(point_ids)
        order = torch.sort(point_ids, stable=True)
        point_ids, places = order.values, places[order.indices]
        ids, counts = torch.unique_consecutive(point_ids, return_counts=True)
        ranks = torch.arange(len(point_ids), device=ids.device) - (
            counts.cumsum(0) - counts
        ).repeat_interleave(counts)
        filled = (self._places[ids] >= 0).sum(1)
        columns = filled.repeat_interleave(counts) + ranks
        self._widen(int(columns.max()) + 1)
        self._places[point_ids, columns] = places.to(self._places.dtype)

    def remove(self, point_ids: Tensor, places: Tensor) -> None:
        """Note that points (n,) are no longer seen at places (n,)."""
        if len(point_ids) == 0:
            return
        ids = torch.unique(point_ids)
        rows = self._places[ids]
        gone = torch.isin(rows, places.to(rows.dtype))
        self._places[ids] = torch.sort(rows.masked_fill(gone, NOWHERE), dim=1, descending=True).values

    def clear(self, point_ids: Tensor) -> None:
        """Note that nobody sees points (n,) any longer."""
        self._reach(point_ids)
        self._places[point_ids] = NOWHERE

    def _reach(self, point_ids: Tensor) -> None:
        """Have a row for every point (n,)."""
        rows, width = self._places.shape
        if len(point_ids) and int(point_ids.max()) >= rows:
            rows = max(2 * rows, int(point_ids.max()) + 1)
            self._resize(rows, width)

    def _widen(self, width: int) -> None:
        """Have room for this many observations of a point."""
        if width > self._places.shape[1]:
            self._resize(len(self._places), max(width, 2 * self._places.shape[1]))

    def _resize(self, rows: int, width: int) -> None:
        old = self._places
        self._places = old.new_full((rows, width), NOWHERE)
        self._places[: old.shape[0], : old.shape[1]] = old


def most(counts: Tensor, limit: int, least: int) -> Tensor:
    """(<= limit,) indices of the largest counts (K,) that are at least `least`, the largest first."""
    enough = torch.nonzero(counts >= least)[:, 0]
    return enough[torch.sort(counts[enough], descending=True, stable=True).indices[:limit]]


def first_of_each(values: Tensor) -> Tensor:
    """(n,) bool, whether a value (n,) stands for the first time."""
    order = torch.sort(values, stable=True)
    is_first = torch.ones_like(values, dtype=torch.bool)
    is_first[order.indices[1:]] = order.values[1:] != order.values[:-1]
    return is_first
