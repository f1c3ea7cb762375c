"""The columns of a world's tables: what they hold, in which shape and which unit.

A letter in a shape is a size that the first row of a table decides: N keypoints a frame, D numbers a descriptor, I
numbers that a front end says of a keypoint's error. Kinds:
"float" is the floating-point type of the geometry, "int" int64, "bool" bool, "byte" uint8, "descriptor" bytes or
floats.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Column:
    """The shape of one row, the kind of its numbers, and what they mean."""

    shape: tuple[int | str, ...]
    kind: str
    about: str

    def why_not(self, values: Tensor) -> str:
        """What is wrong with a column of values, in words; empty where it fits."""
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
    "positions_w": Column((3,), "float", "in the world"),
    "covariances_w": Column((3, 3), "float", "of the position; zero where unknown"),
    "descriptors": Column(("D",), "descriptor", "of the newest observation"),
    "colors": Column((3,), "byte", "red, green, blue in the images; black where unknown"),
    "normals_w": Column((3,), "float", "unit direction from the newest observer to the point"),
    "reach": Column(
        (), "float", "distance times keypoint scale of the newest observation: px times map units"
    ),
    "angles": Column((), "float", "radians, of the newest observation"),
    "last_seen": Column((), "int", "frame that tracked it last"),
    "born": Column((), "int", "row of the keyframe that made it"),
    "from_start": Column((), "bool", "made by the two views that started the map"),
    "times_observed": Column((), "int", "by keyframes"),
    "times_visible": Column((), "int", "frames that should have seen it"),
    "times_found": Column((), "int", "frames that did"),
    "alive": Column((), "bool", "dead rows keep their number until the map is compacted"),
    "replaced_by": Column((), "int", "row of the point it was merged into, or -1"),
}

KEYFRAMES: Schema = {
    "T_cw": Column((4, 4), "float", "world to camera"),
    "covariances": Column((6, 6), "float", "of the pose's left perturbation; zero where unknown"),
    "session": Column((), "int", "which run over this map saw it, from 0"),
    "frame_index": Column((), "int", "in the sequence of its session"),
    "timestamp": Column((), "float", "seconds"),
    "keypoints": Column(("N", 2), "float", "pixels"),
    "scales": Column(("N",), "float", "pixels"),
    "angles": Column(("N",), "float", "radians"),
    "descriptors": Column(("N", "D"), "descriptor", "of the keypoints"),
    "mask": Column(("N",), "bool", "which rows are keypoints"),
    "information": Column(
        ("N", "I"), "float", "px^-2, of their errors: I = 0: by scale, 1, or 3: xx, xy, yy"
    ),
    "point_ids": Column(("N",), "int", "rows of the points that the keypoints observe, or -1"),
}

FRAMES: Schema = {
    "frame_index": Column((), "int", "in the sequence of its session"),
    "session": Column((), "int", "which run over this map saw it, from 0"),
    "timestamp": Column((), "float", "seconds"),
    "T_cr": Column((4, 4), "float", "from the camera of its reference keyframe, in the units of the world"),
    "reference": Column((), "int", "row of that keyframe"),
}

OBSERVATIONS: Schema = {
    "row": Column((), "int", "row of the frame"),
    "point_ids": Column((), "int", "row of the point"),
    "keypoints": Column((), "int", "row of the frame's features"),
    "pixels": Column((2,), "float", "pixels"),
    "scales": Column((), "float", "pixels"),
    "information": Column(("I",), "float", "px^-2, as of the keypoints"),
}
