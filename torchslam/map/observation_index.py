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


class ObservationIndex:
    """For every point the places (keyframe row * N + keypoint) that see it, in rows that are filled from the left.

    A point takes a row when it is seen first and gives it back when nobody sees it: memory goes with the points that
    are seen, not with all that ever were. As that of the table, it is made outside of inference mode.
    """

    @torch.inference_mode(False)
    def __init__(self, table: Tensor) -> None:
        """The index of a table (K, N) of point rows, negative where a keypoint sees nothing."""
        # Half the memory of int64: enough for two million keyframes of a thousand keypoints.
        like = torch.empty(0, dtype=torch.int32, device=table.device)
        self._places = like.new_full((_LEAST_ROWS, _LEAST_WIDTH), NOWHERE)
        self._row_of = like.new_zeros(_LEAST_ROWS)  # by point; row 0 is that of all points that nobody sees
        self._free = torch.arange(_LEAST_ROWS, device=table.device).flip(
            0
        )  # rows without a point: a stack, and
        self._num_free = _LEAST_ROWS - 1  # how high it is
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
        return self._places[self._rows(point_ids)]

    @torch.inference_mode(False)
    def add(self, point_ids: Tensor, places: Tensor) -> None:
        """Note that points (n,) are seen at places (n,); a point may stand there several times."""
        if len(point_ids) == 0:
            return
        order = torch.sort(point_ids, stable=True)
        ids, counts = torch.unique_consecutive(order.values, return_counts=True)
        self._take_rows(ids)
        first = counts.cumsum(0) - counts
        ranks = torch.arange(len(point_ids), device=ids.device) - first.repeat_interleave(counts)
        filled = (self.padded(ids) >= 0).sum(1)
        columns = filled.repeat_interleave(counts) + ranks
        self._widen(int(columns.max()) + 1)
        self._places[self._rows(order.values), columns] = places[order.indices].to(self._places.dtype)

    def remove(self, point_ids: Tensor, places: Tensor) -> None:
        """Note that points (n,) are no longer seen at places (n,)."""
        if len(point_ids) == 0:
            return
        rows = self._rows(torch.unique(point_ids))
        held = self._places[rows]
        gone = torch.isin(held, places.to(held.dtype))
        self._places[rows] = torch.sort(held.masked_fill(gone, NOWHERE), dim=1, descending=True).values

    def clear(self, point_ids: Tensor) -> None:
        """Note that nobody sees points (n,) any longer."""
        rows = torch.unique(self._rows(point_ids))
        rows = rows[rows > 0]
        self._places[rows] = NOWHERE
        self._row_of[point_ids] = 0
        self._free[self._num_free : self._num_free + len(rows)] = rows
        self._num_free += len(rows)

    def _rows(self, point_ids: Tensor) -> Tensor:
        """(n,) where the places of points (n,) are."""
        if len(point_ids) and int(point_ids.max()) >= len(self._row_of):
            self._reach(int(point_ids.max()))
        return self._row_of[point_ids].long()

    @torch.inference_mode(False)
    def _reach(self, point: int) -> None:
        """Know at least all points up to this one."""
        more = self._row_of.new_zeros(max(len(self._row_of), point + 1))
        self._row_of = torch.cat([self._row_of, more])

    def _take_rows(self, point_ids: Tensor) -> None:
        """Have a row of its own for every one of distinct points (n,)."""
        new = point_ids[self._rows(point_ids) == 0]
        rows, width = self._places.shape
        if len(new) > self._num_free:
            more = max(rows, len(new))
            self._resize(rows + more, width)
            fresh = torch.arange(rows, rows + more, device=new.device).flip(0)
            self._free = torch.cat([fresh, self._free])
            self._num_free += more
        left = self._num_free - len(new)
        self._row_of[new] = self._free[left : self._num_free].to(self._row_of.dtype)
        self._num_free = left

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
