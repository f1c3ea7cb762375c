"""The map file: an atlas of submaps and the camera as one safetensors file.

A tensor `submaps.0.points.positions_w` is a column of a table of submap 0; `torchslam.map.table` describes the columns.
The tracking state is not saved: a run that continues in a saved map relocalizes. Reading checks every column against
the schema and every row reference against the tables.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.map.atlas import Atlas, Submap
from torchslam.map.map import Map
from torchslam.map.table import FRAMES, KEYFRAMES, OBSERVATIONS, POINTS, Schema, Table
from torchslam.map.unit import MetricUnit
from torchslam.utils import tensor_file
from torchslam.utils.files import check_regular, parse_json

FORMAT = 2
"""Number of the file format; docs/versions.md lists which version reads which."""
TABLES: dict[str, Schema] = {
    "points": POINTS,
    "keyframes": KEYFRAMES,
    "frames": FRAMES,
    "observations": OBSERVATIONS,
}
CAMERA = "camera.params"
MAX_NUMBER = 1 << 31  # of submaps and of sessions
MAX_BYTES = 1 << 34  # of a map of 100,000 keyframes
MAX_PIXELS = 1 << 26  # of the images; readers of images take no more
MAX_LENGTH = 1e12
"""Of a position in map units and of a pixel's coordinate: products of a few of them stay finite."""

Columns = dict[str, dict[str, Tensor]]
"""Columns by table and name; none if a table is empty."""

_POSES = "T_cw", "T_cr"
_LENGTHS = "positions_w", "keypoints", "detected", "pixels", "scales", "scale_distance", "timestamp"


@dataclass(frozen=True)
class SavedAtlas:
    """The content of a map file.

    Attributes:
        atlas: The submaps.
        camera: The camera of all submaps.
        sessions: Number of sessions (runs over the map) in it; the next session gets this number.
    """

    atlas: Atlas
    camera: Camera
    sessions: int


def write_atlas(path: str | Path, submaps: Iterable[Submap], camera: Camera, sessions: int = 1) -> None:
    """Write submaps and their camera atomically; equal submaps give equal bytes.

    Args:
        sessions: Number of sessions to keep; frames of later sessions, which were only localized, are left out.
    """
    write_tensors(path, *pack_submaps(submaps, camera, sessions))


def read_atlas(path: str | Path, device: torch.device | str = "cpu") -> SavedAtlas:
    """Read and check a file that `write_atlas` wrote, onto a device.

    Raises:
        ResultsError: The file is missing or damaged, belongs to another program or format, or has tables that do not
            fit their schema or each other.
    """
    tensors, about = read_tensors(path)
    return unpack_submaps(path, tensors, about, device)


def read_map(path: str | Path) -> tuple[Map, Camera]:
    """Read the main submap's map, empty if there is no submap, and the camera.

    Raises:
        ResultsError: The file is missing, damaged or no map, as in `read_atlas`.
    """
    saved = read_atlas(path)
    main = saved.atlas.main()
    return Map() if main is None else main.map, saved.camera


def pack_submaps(
    submaps: Iterable[Submap], camera: Camera, sessions: int, num_created: int | None = None
) -> tuple[dict[str, Shaped[Tensor, "..."]], dict[str, Any]]:
    """Convert submaps to tensors by name and a JSON description, with the frames of so many sessions.

    num_created: number of submaps ever created; by default the highest number in use plus one
    """
    submaps = list(submaps)
    tensors, numbers = {CAMERA: camera.params}, []
    for submap in submaps:
        numbers.append(submap.number)
        for name, table in _tables(submap).items():
            columns = _kept(name, table.columns(), submap, sessions)
            tensors |= {f"submaps.{submap.number}.{name}.{column}": rows for column, rows in columns.items()}
    about = {
        "format": FORMAT,
        "camera": {"model": camera.model, "size": list(camera.size)},
        "submaps": numbers,
        "noise_variances": [submap.map.noise_variance for submap in submaps],
        "num_created": max(numbers, default=-1) + 1 if num_created is None else num_created,
        "sessions": sessions,
    }
    metric = {str(submap.number): submap.metric.as_dict() for submap in submaps if submap.metric is not None}
    return tensors, about | ({"metric": metric} if metric else {})


def unpack_submaps(
    path: str | Path,
    tensors: dict[str, Shaped[Tensor, "..."]],
    about: dict[str, Any],
    device: torch.device | str = "cpu",
) -> SavedAtlas:
    """Check and convert the tensors and the description that `pack_submaps` made.

    Raises:
        ResultsError: They are not a valid map; its message names the path.
    """
    try:
        numbers, num_created, sessions = _numbers(about)
        camera = _check_camera(about["camera"], tensors.get(CAMERA))
        unknown: list[str] = []
        columns: Columns = {f"submaps.{number}.{table}": {} for number in numbers for table in TABLES}
        for name, rows in tensors.items():
            table, _, column = name.rpartition(".")
            if table in columns:
                columns[table][column] = rows
            elif name != CAMERA:
                unknown.append(name)
        if unknown:
            raise ValueError(f"unknown tensors: {', '.join(sorted(unknown)[:3])}")
        submaps = []
        for number in numbers:
            own = {table: columns[f"submaps.{number}.{table}"] for table in TABLES}
            submaps.append(_submap(number, own, camera, sessions, device))
        keys = [submap.map.keys for submap in submaps if submap.map.num_keyframes]
        if keys and len(torch.unique(torch.cat(keys))) != sum(map(len, keys)):
            raise ValueError("two keyframes have the same session and frame index")
        variances = about["noise_variances"]
        if not all(isinstance(each, float) and 1 <= each < math.inf for each in variances):
            raise ValueError(f"noise_variances must be {len(numbers)} finite numbers from 1")
        for submap, variance in zip(submaps, variances, strict=True):
            submap.map.noise_variance = variance
            unit = about.get("metric", {}).get(str(submap.number))
            submap.metric = None if unit is None else MetricUnit.from_dict(unit)
    except (ValueError, TypeError, KeyError, AttributeError, RuntimeError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ResultsError(f"{path}: not a whole torchslam map: {what}") from None
    like = camera.params.to(device)
    return SavedAtlas(Atlas(like, submaps, num_created), camera.with_params(like), sessions)


def write_tensors(path: str | Path, tensors: dict[str, Shaped[Tensor, "..."]], about: dict[str, Any]) -> None:
    """Write tensors and their description as one file, atomically; equal content gives equal bytes."""
    tensor_file.write_tensors(path, tensors, {"torchslam": json.dumps(about, sort_keys=True)})


def read_tensors(path: str | Path) -> tuple[dict[str, Shaped[Tensor, "..."]], dict[str, Any]]:
    """Read a file that `write_tensors` wrote.

    Raises:
        ResultsError: It is not readable, or not a map of this format.
    """
    from safetensors import SafetensorError, safe_open

    try:
        check_regular(path, MAX_BYTES, "a map that is read")
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            # In memory of their own: a sum over rows that lie elsewhere in a cache line may have other last bits.
            tensors: dict[str, Tensor] = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise ResultsError(f"{path}: no map file") from None
    except OSError as error:
        raise ResultsError(f"{path}: not a readable safetensors file: {error.strerror or error}") from None
    except (SafetensorError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        # ... or one of a type of numbers, or with a name, that PyTorch does not know
        raise ResultsError(f"{path}: not a readable safetensors file: {error}") from None
    if metadata.keys() != {"torchslam"}:
        raise ResultsError(f"{path}: a safetensors file, but not a torchslam map")
    try:
        about = parse_json(metadata["torchslam"])
        found = about["format"]
    except (ValueError, KeyError, TypeError):
        raise ResultsError(f"{path}: a safetensors file, but not a torchslam map") from None
    if found != FORMAT:
        raise ResultsError(f"{path}: map format {found}, this version reads format {FORMAT}: run again")
    return tensors, about


def _tables(submap: Submap) -> dict[str, Table]:
    """Return the tables of a submap by their names in the file."""
    slam_map, posed_frames = submap.map, submap.posed_frames
    return {
        "points": slam_map.points,
        "keyframes": slam_map.keyframes,
        "frames": posed_frames.frames,
        "observations": posed_frames.observations,
    }


def _kept(name: str, columns: dict[str, Tensor], submap: Submap, sessions: int) -> dict[str, Tensor]:
    """Drop the frames of sessions that are not kept from the columns of a table."""
    if name not in ("frames", "observations") or not columns:
        return columns
    kept = submap.posed_frames.frames["session"] < sessions
    if bool(kept.all()):
        return columns
    if not bool(kept.any()):
        return {}
    kept = kept if name == "frames" else kept[columns["frame_row"]]
    return {column: rows[kept] for column, rows in columns.items()}


def _numbers(about: dict[str, Any]) -> tuple[list[int], int, int]:
    """Return the checked numbers of the submaps, the number ever created and the number of sessions."""
    numbers, num_created, sessions = about["submaps"], about["num_created"], about["sessions"]
    whole = [*numbers, num_created, sessions]
    if not all(type(number) is int and 0 <= number < MAX_NUMBER for number in whole):
        raise ValueError(
            f"submaps {numbers}, num_created {num_created}, sessions {sessions}: must be numbers from 0 to {MAX_NUMBER}"
        )
    if len(set(numbers)) != len(numbers) or max(numbers, default=-1) >= num_created:
        raise ValueError(f"submaps {numbers}: numbers must differ and lie below num_created = {num_created}")
    return numbers, num_created, sessions


def _submap(
    number: int, columns: Columns, camera: Camera, sessions: int, device: torch.device | str
) -> Submap:
    """Check the columns of a submap and build it of them."""
    submap = Submap.empty(number, camera.params.to(device))
    sizes: dict[str, int] = {}
    try:
        for name, table in _tables(submap).items():
            if columns[name]:
                table.append(**{column: rows.to(device) for column, rows in columns[name].items()})
                _check_table(columns[name], TABLES[name], camera.params.dtype, sizes)
        name = "references"
        _check_rows(columns, sessions)
    except ValueError as error:
        raise ValueError(f"submap {number}, {name}: {error}") from None
    if len({columns[name]["descriptors"].dtype for name in ("points", "keyframes") if columns[name]}) > 1:
        raise ValueError(f"submap {number}: descriptors of several types")
    return submap


def _check_camera(about: dict[str, Any], params: Tensor | None) -> Camera:
    """Build the camera from its description and parameters."""
    if params is None:
        raise ValueError("the camera's parameters are missing")
    width, height = about["size"]
    if not all(isinstance(side, int) and side > 0 for side in (width, height)) or width * height > MAX_PIXELS:
        raise ValueError(f"an image of {width} x {height} pixels")
    if params.ndim != 1 or params.dtype not in (torch.float32, torch.float64):
        raise ValueError("the camera's parameters are not a row of numbers")
    if not bool((params.abs() < MAX_LENGTH).all()) or not bool((params[:2] > 0).all()):
        raise ValueError("the camera's parameters are not finite numbers with a positive focal length")
    return Camera(about["model"], params, (width, height))


def _check_table(
    columns: dict[str, Tensor], schema: Schema, dtype: torch.dtype, sizes: dict[str, int]
) -> None:
    """Check types and values of a table that fits its schema; `sizes` collects what all tables must agree on."""
    for name, rows in columns.items():
        column = schema[name]
        for wanted, size in zip(column.shape, rows.shape[1:], strict=True):
            if isinstance(wanted, str) and sizes.setdefault(wanted, size) != size:
                raise ValueError(f"{name}: {wanted} is {size}, elsewhere {sizes[wanted]}")
        if column.kind == "float" and rows.dtype != (torch.float64 if name == "timestamp" else dtype):
            raise ValueError(f"{name}: {rows.dtype} but the camera is {dtype}")
        if rows.is_floating_point():
            _check_numbers(name, rows)


def _check_numbers(name: str, rows: Tensor) -> None:
    """Check that the numbers of a column are finite, its lengths of a possible size and its poses rigid."""
    if not bool(torch.isfinite(rows).all()):
        raise ValueError(f"{name}: not finite")
    if name in _POSES:
        R, last = rows[:, :3, :3], rows.new_tensor([0.0, 0.0, 0.0, 1.0])
        skew = (R.mT @ R - torch.eye(3, dtype=R.dtype, device="cpu")).abs()
        if not bool((skew <= 1e-3).all()) or not bool((rows[:, 3] == last).all()):
            raise ValueError(f"{name}: not rigid transforms")
    lengths = rows[:, :3, 3] if name in _POSES else rows
    if name in (*_POSES, *_LENGTHS) and not bool((lengths.abs() <= MAX_LENGTH).all()):
        raise ValueError(f"{name}: beyond {MAX_LENGTH:g}")


def _check_rows(columns: Columns, sessions: int) -> None:
    """Check that every reference to a row is in range."""
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
        least, top_rows = int(rows.min()), int(rows.max())
        if least < low or (end is not None and top_rows >= end):
            limit = "" if end is None else f" to {end - 1}"
            raise ValueError(f"{name} from {least} to {top_rows}, there are {low}{limit}")
    if points:
        replacement = torch.cat(
            [points["replaced_by"], points["replaced_by"].new_tensor([-1])]
        )  # -1 reads the last entry
        for _ in range(len(replacement).bit_length()):  # each round doubles the steps
            replacement = replacement[replacement]
        if bool((replacement >= 0).any()):
            raise ValueError("replaced_by has a cycle")
