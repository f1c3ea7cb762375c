"""Tables of a submap: columns of tensors that grow together, and their schemas, which are also those of the map file.

A letter in a shape is a size that the first row of a table fixes: N keypoints per frame, D numbers per descriptor, I
numbers of keypoint information (0, 1 or 3). Kinds: "float" is the floating-point type of the geometry, "int" int64,
"bool" bool, "byte" uint8, "descriptor" bytes or floats.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Int, Shaped
from torch import Tensor


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        shape: Of one row; a letter is a size that the first row fixes.
        kind: Of its numbers, a key of `_KINDS`.
        about: A description.
    """

    shape: tuple[int | str, ...]
    kind: str
    about: str

    def mismatch(self, values: Shaped[Tensor, "..."]) -> str:
        """Describe how values violate the column; empty if they fit."""
        row = tuple(values.shape[1:])
        fits = len(row) == len(self.shape) and all(
            isinstance(wanted, str) or wanted == size for wanted, size in zip(self.shape, row, strict=True)
        )
        if values.ndim == 0 or not fits:
            return f"rows must have the shape {self.shape}, not {row}"
        if not _KINDS[self.kind](values.dtype):
            return f"must be of kind {self.kind}, not {values.dtype}"
        return ""


_KINDS = {
    "float": lambda dtype: dtype in (torch.float32, torch.float64),
    "int": lambda dtype: dtype == torch.int64,
    "bool": lambda dtype: dtype == torch.bool,
    "byte": lambda dtype: dtype == torch.uint8,
    "descriptor": lambda dtype: dtype == torch.uint8 or dtype.is_floating_point,
}

Schema = dict[str, Column]

POINTS: Schema = {
    "positions_w": Column((3,), "float", "position in the submap's frame"),
    "covariances_w": Column((3, 3), "float", "covariance of the position; zero where unknown"),
    "descriptors": Column(("D",), "descriptor", "descriptor of the newest observation"),
    "colors": Column((3,), "byte", "red, green, blue in the images; black where unknown"),
    "view_directions_w": Column((3,), "float", "unit direction from the newest observing keyframe"),
    "scale_distance": Column(
        (), "float", "keypoint scale times distance, newest observation: px times map units"
    ),
    "angles": Column((), "float", "keypoint orientation of the newest observation, radians"),
    "last_seen_frame": Column((), "int", "index of the last frame that tracked the point"),
    "first_keyframe": Column((), "int", "row of the keyframe that created the point"),
    "from_initialization": Column((), "bool", "created by the two-view initialization"),
    "times_observed": Column((), "int", "number of keyframes that observe the point"),
    "times_visible": Column((), "int", "number of frames in which the point should have been visible"),
    "times_found": Column((), "int", "number of frames in which the point was matched"),
    "is_valid": Column((), "bool", "false for removed points, whose rows stay until the submap is compacted"),
    "replaced_by": Column((), "int", "row of the point that this one was merged into, or -1"),
}
"""Columns of the points."""

KEYFRAMES: Schema = {
    "T_cw": Column((4, 4), "float", "pose, world to camera"),
    "covariances": Column((6, 6), "float", "covariance of the pose's left perturbation; zero where unknown"),
    "session": Column((), "int", "session that observed the keyframe, from 0"),
    "frame_index": Column((), "int", "index in the sequence of its session"),
    "timestamp": Column((), "float", "seconds"),
    "keypoints": Column(("N", 2), "float", "pixels of a global shutter, at the time of the middle row"),
    "detected": Column(("N", 2), "float", "pixels of the detected keypoints"),
    "scales": Column(("N",), "float", "pixels"),
    "angles": Column(("N",), "float", "radians"),
    "descriptors": Column(("N", "D"), "descriptor", "descriptors of the keypoints"),
    "mask": Column(("N",), "bool", "true for valid keypoints"),
    "information": Column(("N", "I"), "float", "px^-2. I = 0: from the scale; 1: isotropic; 3: xx, xy, yy"),
    "point_ids": Column(("N",), "int", "row of the point that each keypoint observes, or -1"),
}
"""Columns of the keyframes."""

FRAMES: Schema = {
    "frame_index": Column((), "int", "index in the sequence of its session"),
    "session": Column((), "int", "session that observed the frame, from 0"),
    "timestamp": Column((), "float", "seconds"),
    "T_cr": Column((4, 4), "float", "pose relative to the reference keyframe, in map units"),
    "reference_keyframe": Column((), "int", "row of the reference keyframe"),
}
"""Columns of the frames between keyframes."""

OBSERVATIONS: Schema = {
    "frame_row": Column((), "int", "row of the frame"),
    "point_ids": Column((), "int", "row of the point"),
    "keypoint_index": Column((), "int", "row among the frame's keypoints"),
    "pixels": Column((2,), "float", "pixels"),
    "scales": Column((), "float", "pixels"),
    "information": Column(("I",), "float", "px^-2, as for the keypoints"),
}
"""Columns of the observations of frames."""


class Table:
    """Named columns with one row per item; capacity grows by half when it is used up, so appending a row costs O(1).

    The schema fixes names, shapes and kinds; the first `append` fixes dtypes, device and the sizes that the schema
    leaves open. `table["name"]` is a view of the rows in use: writing into it writes into the table. Appended tensors
    are detached. Memory is allocated outside of inference mode, so that autograd can read it.
    """

    def __init__(self, schema: Schema) -> None:
        self.schema = schema
        self._columns: dict[str, Tensor] = {}
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, name: str) -> Shaped[Tensor, "R ..."]:
        """Return a view of a column."""
        return self._columns[name][: self._size]

    def columns(self) -> dict[str, Shaped[Tensor, "R ..."]]:
        """Return all columns by name, rows in use only."""
        return {name: self[name] for name in self._columns}

    @torch.inference_mode(False)
    def append(self, **rows: Shaped[Tensor, "_ ..."]) -> Int[Tensor, " R"]:
        """Append rows, one tensor per column, and return their indices.

        Raises:
            ValueError: Columns do not fit the schema or each other.
        """
        self._check(rows)
        start, end = self._size, self._size + len(next(iter(rows.values())))
        for name, values in rows.items():
            self._columns[name] = self._grown(name, values, end)
            self._columns[name][start:end] = values.detach()
        self._size = end
        return torch.arange(start, end, device=next(iter(rows.values())).device)

    @torch.inference_mode(False)
    def keep(self, rows: Int[Tensor, " R"]) -> None:
        """Keep the rows in this order and remove the others; memory is freed if most of it would be unused."""
        for name, column in self._columns.items():
            kept = self[name][rows]
            if 2 * len(rows) < len(column):
                self._columns[name] = kept
            else:
                column[: len(rows)] = kept
        self._size = len(rows)

    def truncate(self, size: int) -> None:
        """Remove the rows from `size` on."""
        self._size = min(size, self._size)

    def _check(self, rows: dict[str, Tensor]) -> None:
        if wrong := rows.keys() ^ self.schema.keys():
            raise ValueError(f"missing or unknown columns: {', '.join(sorted(wrong))}")
        counts = set(map(len, rows.values()))
        if len(counts) != 1:
            raise ValueError(f"the columns have {min(counts)} to {max(counts)} rows")
        for name, values in rows.items():
            if mismatch := self.schema[name].mismatch(values):
                raise ValueError(f"column {name}: {mismatch}")

    def _grown(self, name: str, values: Tensor, size: int) -> Tensor:
        old = self._columns.get(name, values.new_zeros(0, *values.shape[1:]))
        if len(old) >= size:
            return old
        new = values.new_zeros(max(64, size, 3 * len(old) // 2), *values.shape[1:])
        new[: self._size] = old[: self._size]
        return new
