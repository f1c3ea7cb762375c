"""Columns of tensors that grow together: the storage of a world."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.map.schema import Schema


class Table:
    """Named columns with one row per item; capacity doubles when it is used up, so appending costs O(1) a row.

    The schema fixes names, shapes and kinds; the first `append` fixes dtypes, device and the sizes that the schema
    leaves open. `table["name"]` is a view of the rows in use: writing into it writes into the table. What is appended
    is detached: a world holds values, not graphs. Its memory is made outside of inference mode, so that autograd may
    read it and anybody may write it.
    """

    def __init__(self, schema: Schema) -> None:
        self.schema = schema
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

    @torch.inference_mode(False)
    def append(self, **rows: Tensor) -> Tensor:
        """Add rows, one tensor (n, ...) per column; returns their ids (n,) int64.

        Raises ValueError for columns that the schema does not have, or that do not fit it or each other.
        """
        self._check(rows)
        start, end = self._size, self._size + len(next(iter(rows.values())))
        for name, values in rows.items():
            self._columns[name] = self._grown(name, values, end)
            self._columns[name][start:end] = values.detach()
        self._size = end
        return torch.arange(start, end, device=next(iter(rows.values())).device)

    @torch.inference_mode(False)
    def keep(self, rows: Tensor) -> None:
        """Keep some rows (n,), by index, in this order; the others are gone.

        Their memory is given back where most of it would stay empty; otherwise the next rows go there.
        """
        for name, column in self._columns.items():
            kept = self[name][rows]
            if 2 * len(rows) < len(column):
                self._columns[name] = kept
            else:
                column[: len(rows)] = kept
        self._size = len(rows)

    def cut(self, size: int) -> None:
        """Forget the rows from `size` on; the next ones go there."""
        self._size = min(size, self._size)

    def _check(self, rows: dict[str, Tensor]) -> None:
        if rows.keys() != self.schema.keys():
            raise ValueError(f"columns are {sorted(self.schema)}, not {sorted(rows)}")
        counts = {name: len(values) for name, values in rows.items()}
        if len(set(counts.values())) != 1:
            raise ValueError(f"the columns of one append differ in length: {counts}")
        for name, values in rows.items():
            wrong = self.schema[name].mismatch(values)
            if wrong:
                raise ValueError(f"column {name}: {wrong}")

    def _grown(self, name: str, values: Tensor, size: int) -> Tensor:
        old = self._columns.get(name)
        if old is not None and len(old) >= size:
            return old
        capacity = max(64, size, 2 * (0 if old is None else len(old)))
        new = torch.zeros(capacity, *values.shape[1:], dtype=values.dtype, device=values.device)
        if old is not None:
            new[: self._size] = old[: self._size]
        return new
