"""Are columns that were read from a file the tables of a world? Every function raises ValueError where they are not."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchslam.geometry import Camera
from torchslam.map.map import Map
from torchslam.map.schema import Schema
from torchslam.types import FrameFeatures

Columns = dict[str, dict[str, Tensor]]
"""Columns by table and name; no columns at all where a table is empty."""

# What everything else is computed from.
FINITE = (
    "T_cw",
    "T_cr",
    "positions_w",
    "timestamp",
    "keypoints",
    "scales",
    "pixels",
    "scale_distance",
    "information",
)


def check_camera(about: dict[str, Any], params: Tensor | None) -> Camera:
    """The camera of its description and its parameters."""
    if params is None:
        raise ValueError("the camera's parameters are missing")
    width, height = about["size"]
    if not all(isinstance(side, int) and side > 0 for side in (width, height)):
        raise ValueError(f"an image of {width} x {height} pixels")
    if params.ndim != 1 or not params.is_floating_point() or not bool(torch.isfinite(params).all()):
        raise ValueError("the camera's parameters are not a row of finite numbers")
    return Camera(about["model"], params, (width, height))


def check_world(
    number: int, columns: Columns, tables: dict[str, Schema], dtype: torch.dtype, sessions: int
) -> None:
    """Columns are those of the schema, agree in sizes and types, and refer to rows that there are."""
    sizes: dict[str, int] = {}
    descriptors: set[torch.dtype] = set()
    for name, schema in tables.items():
        try:
            _check_table(columns[name], schema, dtype, sizes, descriptors)
        except ValueError as error:
            raise ValueError(f"world {number}, {name}: {error}") from None
    try:
        _check_rows(columns, sessions)
    except ValueError as error:
        raise ValueError(f"world {number}: {error}") from None


def check_keys(maps: list[Map]) -> None:
    """No two keyframes of all maps are of the same frame."""
    keys = [slam_map.keys for slam_map in maps if slam_map.num_keyframes]
    if keys and len(torch.unique(torch.cat(keys))) != sum(map(len, keys)):
        raise ValueError("two keyframes are of the same frame")


def why_not_alike(slam_map: Map, view: FrameFeatures, to_map: bool) -> str:
    """Why a frame's features cannot be compared with the map's, in words; empty where they can.

    to_map: whether frames are to become keyframes, which all have room for the same number of keypoints
    """
    if slam_map.num_keyframes == 0:
        return ""
    held, seen = slam_map.keyframes["descriptors"], view.descriptors
    if held.shape[-1] != seen.shape[-1] or held.dtype != seen.dtype:
        return f"its descriptors are {held.shape[-1]} x {held.dtype}, the frame's {seen.shape[-1]} x {seen.dtype}"
    known, said = slam_map.keyframes["information"].shape[-1], view.information.shape[-1]
    if to_map and known != said:
        kinds = {0: "none", 1: "a number", 3: "a matrix"}
        return f"its keypoints have {kinds[known]} as information, the frame's {kinds[said]}"
    if to_map and held.shape[1] != len(seen):
        return f"its keyframes have {held.shape[1]} keypoints, the frame {len(seen)}"
    return ""


def _check_table(
    columns: dict[str, Tensor],
    schema: Schema,
    dtype: torch.dtype,
    sizes: dict[str, int],
    descriptors: set[torch.dtype],
) -> None:
    """One table against its schema; `sizes` and `descriptors` gather what the tables of a world must agree on."""
    if not columns:
        return
    missing, foreign = sorted(schema.keys() - columns.keys()), sorted(columns.keys() - schema.keys())
    if missing or foreign:
        raise ValueError(
            "; ".join(
                f"{what} {', '.join(names)}"
                for what, names in (("missing", missing), ("foreign", foreign))
                if names
            )
        )
    lengths = {len(rows) for rows in columns.values() if rows.ndim}
    for name, rows in columns.items():
        column = schema[name]
        wrong = column.mismatch(rows)
        if wrong:
            raise ValueError(f"{name}: {wrong}")
        if len(lengths) > 1:
            raise ValueError(f"the columns have {min(lengths)} to {max(lengths)} rows")
        for wanted, size in zip(column.shape, rows.shape[1:], strict=True):
            if isinstance(wanted, str) and sizes.setdefault(wanted, size) != size:
                raise ValueError(f"{name}: {wanted} is {size}, elsewhere {sizes[wanted]}")
        if column.kind == "float" and rows.dtype != (torch.float64 if name == "timestamp" else dtype):
            raise ValueError(f"{name}: {rows.dtype} beside a camera in {dtype}")
        if column.kind == "descriptor":
            descriptors.add(rows.dtype)
        if name in FINITE and not bool(torch.isfinite(rows).all()):
            raise ValueError(f"{name}: not finite")
    if len(descriptors) > 1:
        raise ValueError("descriptors of several types")


def _check_rows(columns: Columns, sessions: int) -> None:
    """Whatever names a row names one that is there."""
    points, keyframes, frames, seen = (
        columns[name] for name in ("points", "keyframes", "frames", "observations")
    )
    num_points, num_keyframes, num_frames = (
        len(next(iter(table.values()), ())) for table in (points, keyframes, frames)
    )
    ranges = (
        (points, "first_keyframe", 0, num_keyframes),
        (points, "replaced_by", -1, num_points),
        (keyframes, "point_ids", -1, num_points),
        (keyframes, "session", 0, sessions),
        (keyframes, "frame_index", 0, None),
        (frames, "session", 0, sessions),
        (frames, "frame_index", 0, None),
        (frames, "reference_keyframe", 0, num_keyframes),
        (seen, "frame_row", 0, num_frames),
        (seen, "point_ids", 0, num_points),
        (seen, "keypoint_index", 0, None),
    )
    for table, name, low, end in ranges:
        rows = table.get(name)
        if rows is None or rows.numel() == 0:
            continue
        least, most = int(rows.min()), int(rows.max())
        if least < low or (end is not None and most >= end):
            limit = "" if end is None else f" to {end - 1}"
            raise ValueError(f"{name} from {least} to {most}, there are {low}{limit}")
    if points:
        _check_heirs(points["replaced_by"])


def _check_heirs(replaced_by: Tensor) -> None:
    """Following what replaced a point ends: no point inherits from itself."""
    heir = torch.cat([replaced_by, replaced_by.new_tensor([-1])])  # NO_POINT reads the last entry
    for _ in range(len(replaced_by).bit_length()):  # each round doubles the steps
        heir = heir[heir]
    if bool((heir >= 0).any()):
        raise ValueError("replaced_by goes in a circle")
