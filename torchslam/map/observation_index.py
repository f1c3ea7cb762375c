"""Inverted index from points to observations.

The table of keyframes lists the points of each keyframe; this index lists for each point the slots of that table which
observe it, so that a query costs O(observations of the queried points). It is derived from the table and never saved.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

NO_SLOT = -1
"""Instead of a slot: fills the rows of points with fewer observations."""
_LEAST_ROWS, _LEAST_WIDTH = 64, 4
"""Rows and columns of a new index; both double when they are full."""


class ObservationIndex:
    """For every point the slots (keyframe row * N + keypoint) that observe it, in rows filled from the left.

    Only observed points have a row, so memory grows with them and not with all points ever made. Memory is allocated
    outside of inference mode, like that of the table.
    """

    @torch.inference_mode(False)
    def __init__(self, table: Int[Tensor, "K N"]) -> None:
        """Index a table of point rows, negative where a keypoint observes nothing."""
        # Half the memory of int64: enough for two million keyframes of a thousand keypoints.
        like = torch.empty(0, dtype=torch.int32, device=table.device)
        self._slots = like.new_full((_LEAST_ROWS, _LEAST_WIDTH), NO_SLOT)
        self._row_of = like.new_zeros(_LEAST_ROWS)  # by point; row 0 stands for all without observations
        self._free = torch.arange(_LEAST_ROWS, device=table.device).flip(0)  # a stack of rows without a point
        self._num_free = _LEAST_ROWS - 1
        flat = table.flatten()
        slots = torch.nonzero(flat >= 0)[:, 0]
        self.add(flat[slots], slots)

    def observations_of(self, point_ids: Int[Tensor, " N"]) -> tuple[Int[Tensor, " O"], Int[Tensor, " O"]]:
        """Return for every observation of points the position of its point in `point_ids` and its slot."""
        slots = self.padded_slots(point_ids)
        which, column = torch.nonzero(slots >= 0, as_tuple=True)
        return which, slots[which, column].long()

    def padded_slots(self, point_ids: Int[Tensor, " N"]) -> Int[Tensor, "N R"]:
        """Return the slots that observe points, padded with NO_SLOT."""
        return self._slots[self._rows(point_ids)]

    @torch.inference_mode(False)
    def add(self, point_ids: Int[Tensor, " O"], slots: Int[Tensor, " O"]) -> None:
        """Add observations of points at slots; points may repeat."""
        if len(point_ids) == 0:
            return
        order = torch.sort(point_ids, stable=True)
        ids, counts = torch.unique_consecutive(order.values, return_counts=True)
        self._take_rows(ids)
        first = counts.cumsum(0) - counts
        filled = (self.padded_slots(ids) >= 0).sum(1)
        columns = torch.arange(len(point_ids), device=ids.device) + (filled - first).repeat_interleave(counts)
        rows, width = self._slots.shape
        if (needed := int(columns.max()) + 1) > width:
            self._resize(rows, max(needed, 2 * width))
        self._slots[self._rows(order.values), columns] = slots[order.indices].to(self._slots.dtype)

    def remove(self, point_ids: Int[Tensor, " O"], slots: Int[Tensor, " O"]) -> None:
        """Remove observations of points at slots."""
        if len(point_ids) == 0:
            return
        rows = self._rows(torch.unique(point_ids))
        held = self._slots[rows]
        gone = torch.isin(held, slots.to(held.dtype))
        self._slots[rows] = torch.sort(held.masked_fill(gone, NO_SLOT), dim=1, descending=True).values

    def clear(self, point_ids: Int[Tensor, " N"]) -> None:
        """Remove all observations of points."""
        rows = torch.unique(self._rows(point_ids))
        rows = rows[rows > 0]
        self._slots[rows] = NO_SLOT
        self._row_of[point_ids] = 0
        self._free[self._num_free : self._num_free + len(rows)] = rows
        self._num_free += len(rows)

    def _rows(self, point_ids: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
        """Return the rows of points."""
        if len(point_ids) and (last := int(point_ids.max())) >= len(self._row_of):
            with torch.inference_mode(False):
                more = self._row_of.new_zeros(max(len(self._row_of), last + 1))
                self._row_of = torch.cat([self._row_of, more])
        return self._row_of[point_ids].long()

    def _take_rows(self, point_ids: Int[Tensor, " N"]) -> None:
        """Assign a row to each of distinct points that has none."""
        new = point_ids[self._rows(point_ids) == 0]
        rows, width = self._slots.shape
        if len(new) > self._num_free:
            more = max(rows, len(new))
            self._resize(rows + more, width)
            fresh = torch.arange(rows, rows + more, device=new.device).flip(0)
            self._free = torch.cat([fresh, self._free])
            self._num_free += more
        left = self._num_free - len(new)
        self._row_of[new] = self._free[left : self._num_free].to(self._row_of.dtype)
        self._num_free = left

    def _resize(self, rows: int, width: int) -> None:
        old = self._slots
        self._slots = old.new_full((rows, width), NO_SLOT)
        self._slots[: old.shape[0], : old.shape[1]] = old


def top_rows(counts: Shaped[Tensor, " N"], limit: int, least: int) -> Int[Tensor, " R"]:
    """Return the indices of at most `limit` largest counts that are at least `least`, in descending order."""
    enough = torch.nonzero(counts >= least)[:, 0]
    return enough[torch.sort(counts[enough], descending=True, stable=True).indices[:limit]]


def first_of_each(values: Int[Tensor, " N"]) -> Bool[Tensor, " N"]:
    """Test which values occur for the first time."""
    order = torch.sort(values, stable=True)
    is_first = torch.ones_like(values, dtype=torch.bool)
    is_first[order.indices[1:]] = order.values[1:] != order.values[:-1]
    return is_first
