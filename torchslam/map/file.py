"""Everything that a run keeps, as one safetensors file: its worlds, table by table, and the camera.

A tensor `worlds.0.points.positions_w` is a column of a table of world 0; `torchslam.map.schema` says what it holds.
Where the camera was last is not in it: who goes on in a saved map finds itself in it. A file that is read is checked
column by column and row by row, so that nothing later stumbles over it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.map.atlas import Atlas
from torchslam.map.map import Map
from torchslam.map.schema import FRAMES, KEYFRAMES, OBSERVATIONS, POINTS, Schema
from torchslam.map.submap import Submap
from torchslam.map.table import Table
from torchslam.map.validation import check_camera, check_keys, check_world
from torchslam.utils.atomic_write import write_whole
from torchslam.utils.bounded_read import check_regular, parse_json

FORMAT = 1
TABLES: dict[str, Schema] = {
    "points": POINTS,
    "keyframes": KEYFRAMES,
    "frames": FRAMES,
    "observations": OBSERVATIONS,
}
CAMERA = "camera.params"
MOST = 1 << 31  # worlds and sessions
MAX_BYTES = 1 << 34  # of a map of 100,000 keyframes


@dataclass(frozen=True)
class Saved:
    """What a file holds.

    sessions: how many runs over the map are in it; the next one has this number
    """

    worlds: Atlas
    camera: Camera
    sessions: int


def write_atlas(path: str | Path, worlds: Iterable[Submap], camera: Camera, sessions: int = 1) -> None:
    """Write all of the worlds, dead points included, and their camera, whole or not at all; same worlds, same bytes.

    sessions: frames of sessions from this number on were only localised, and are left out
    """
    write_tensors(path, *pack(worlds, camera, sessions))


def read_atlas(path: str | Path, device: torch.device | str = "cpu") -> Saved:
    """What `write_atlas` wrote.

    Raises ResultsError for a missing or damaged file, one of another program or format, and one whose tables do not
    fit their schema or each other; the message names the file and what is wrong.
    """
    tensors, about = read_tensors(path)
    return unpack(path, tensors, about, device)


def read_map(path: str | Path) -> tuple[Map, Camera]:
    """The map of the world in which most frames are posed, empty where there is none, and the camera.

    Raises ResultsError as `read_atlas` does.
    """
    saved = read_atlas(path)
    main = saved.worlds.main()
    return Map() if main is None else main.map, saved.camera


def pack(
    worlds: Iterable[Submap], camera: Camera, sessions: int, begun: int | None = None
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and description of worlds; `begun`: how many ever began, by default up to the last that is left."""
    tensors, numbers = {CAMERA: camera.params}, []
    for world in worlds:
        numbers.append(world.number)
        for name, table in _tables(world).items():
            columns = _kept(name, table.columns(), world, sessions)
            tensors |= {f"worlds.{world.number}.{name}.{column}": rows for column, rows in columns.items()}
    about = {
        "format": FORMAT,
        "camera": {"model": camera.model, "size": list(camera.size)},
        "worlds": numbers,
        "begun": max(numbers, default=-1) + 1 if begun is None else begun,
        "sessions": sessions,
    }
    return tensors, about


def unpack(
    path: str | Path, tensors: dict[str, Tensor], about: dict[str, Any], device: torch.device | str = "cpu"
) -> Saved:
    """Worlds of tensors and a description that `pack` made. Raises ResultsError where they are something else."""
    try:
        numbers, begun, sessions = _numbers(about)
        camera = check_camera(about["camera"], tensors.get(CAMERA))
        expected = {f"worlds.{number}." for number in numbers}
        foreign = [
            name
            for name in tensors
            if name != CAMERA and not any(name.startswith(start) for start in expected)
        ]
        if foreign:
            raise ValueError(f"foreign tensors: {', '.join(sorted(foreign)[:3])}")
        worlds = []
        for number in numbers:
            start = f"worlds.{number}."
            own = {name[len(start) :]: rows for name, rows in tensors.items() if name.startswith(start)}
            worlds.append(_world(number, own, camera, sessions, device))
        check_keys([world.map for world in worlds])
    except (ValueError, TypeError, KeyError, AttributeError, RuntimeError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ResultsError(f"{path}: not a whole torchslam map: {what}") from None
    like = camera.params.to(device)
    return Saved(Atlas.of(worlds, begun, like), camera.with_params(like), sessions)


def write_tensors(path: str | Path, tensors: dict[str, Tensor], about: dict[str, Any]) -> None:
    """One file of tensors and their description, whole or not at all; same content, same bytes."""
    from safetensors.torch import save

    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # One metadata entry: several would be written in an order that differs from run to run.
    write_whole(path, save(tensors, metadata={"torchslam": json.dumps(about, sort_keys=True)}))


def read_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `write_tensors` wrote, of this format. Raises ResultsError that names the file."""
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


def _tables(world: Submap) -> dict[str, Table]:
    """All tables of a world by their names in a file."""
    slam_map, history = world.map, world.history
    return dict(
        zip(TABLES, (slam_map.points, slam_map.keyframes, history.frames, history.observations), strict=True)
    )


def _kept(name: str, columns: dict[str, Tensor], world: Submap, sessions: int) -> dict[str, Tensor]:
    """The columns without the frames of sessions that are not kept; those come last."""
    if name not in ("frames", "observations") or not columns:
        return columns
    kept = world.history.frames["session"] < sessions
    if bool(kept.all()):
        return columns
    if not bool(kept.any()):
        return {}
    kept = kept if name == "frames" else kept[columns["frame_row"]]
    return {column: rows[kept] for column, rows in columns.items()}


def _numbers(about: dict[str, Any]) -> tuple[list[int], int, int]:
    """The numbers of the worlds, how many ever began, and how many sessions there were."""
    numbers, begun, sessions = about["worlds"], about["begun"], about["sessions"]
    whole = [*numbers, begun, sessions]
    if not all(type(number) is int and 0 <= number < MOST for number in whole):
        raise ValueError(
            f"worlds {numbers}, begun {begun}, sessions {sessions}: must be numbers from 0 to {MOST}"
        )
    if len(set(numbers)) != len(numbers) or max(numbers, default=-1) >= begun:
        raise ValueError(f"worlds {numbers} of {begun} that began: numbers must differ and lie below")
    return numbers, begun, sessions


def _world(
    number: int, tensors: dict[str, Tensor], camera: Camera, sessions: int, device: torch.device | str
) -> Submap:
    """One world of its columns `points.positions_w`, ..., which are checked."""
    world = Submap.empty(number, camera.params.to(device))
    columns: dict[str, dict[str, Tensor]] = {name: {} for name in TABLES}
    for name, rows in tensors.items():
        owner, _, column = name.partition(".")
        if owner not in columns:
            raise ValueError(f"world {number} has a foreign tensor {name}")
        columns[owner][column] = rows
    check_world(number, columns, TABLES, camera.params.dtype, sessions)
    for name, table in _tables(world).items():
        if columns[name]:
            table.append(**{column: rows.to(device) for column, rows in columns[name].items()})
    return world
