"""Columns of tensors that grow together: the storage of the map."""

from __future__ import annotations

import torch
from torch import Tensor


class Table:
    """Named columns with one row per item; capacity doubles when it is used up, so appending costs O(1) a row.

    The first `append` fixes the columns, their dtypes and shapes. `table["name"]` is a view of the rows in use:
    writing into it writes into the table. What is appended is detached: the map holds values, not graphs.
    """

    def __init__(self) -> None:
        self._columns: dict[str, Tensor] = {}
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    def __getitem__(self, name: str) -> Tensor:
        return self._columns[name][: self._size]

    def columns(self) -> dict[str, Tensor]:
        """All columns by name, the rows in use."""
        return {name: self[name] for name in self._columns}

    def append(self, **rows: Tensor) -> Tensor:
        """Add rows, one tensor (n, ...) per column; returns their ids (n,) int64."""
        counts = {name: len(values) for name, values in rows.items()}
        if len(set(counts.values())) != 1:
            raise ValueError(f"the columns of one append differ in length: {counts}")
        if self._columns and rows.keys() != self._columns.keys():
            raise ValueError(f"columns are {sorted(self._columns)}, not {sorted(rows)}")
        start, end = self._size, self._size + next(iter(counts.values()))
        for name, values in rows.items():
            self._columns[name] = self._grown(name, values, end)
            self._columns[name][start:end] = values.detach()
        self._size = end
        return torch.arange(start, end, device=next(iter(rows.values())).device)

    def _grown(self, name: str, values: Tensor, size: int) -> Tensor:
        old = self._columns.get(name)
        if old is not None and len(old) >= size:
            return old
        capacity = max(64, size, 2 * (0 if old is None else len(old)))
        new = torch.zeros(capacity, *values.shape[1:], dtype=values.dtype, device=values.device)
        if old is not None:
            new[: self._size] = old[: self._size]
        return new
