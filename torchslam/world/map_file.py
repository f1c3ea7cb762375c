"""The map as one safetensors file: columns `points.*` and `keyframes.*`, and the camera."""

from __future__ import annotations

import json
from pathlib import Path

from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.world.map import Map

FORMAT = 2  # 1 had no covariances


def write_map(path: str | Path, slam_map: Map, camera: Camera) -> None:
    """Write all of a map, dead points included (ids are row numbers), and its camera; same map, same bytes."""
    from safetensors.torch import save

    tensors = {f"points.{name}": column for name, column in slam_map.points.columns().items()}
    tensors |= {f"keyframes.{name}": column for name, column in slam_map.keyframes.columns().items()}
    tensors["camera.params"] = camera.params
    # One metadata entry: several would be written in an order that differs from run to run.
    about = {"format": FORMAT, "camera": {"model": camera.model, "size": list(camera.size)}}
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    Path(path).write_bytes(save(tensors, metadata={"torchslam": json.dumps(about, sort_keys=True)}))


def read_map(path: str | Path) -> tuple[Map, Camera]:
    """The map and the camera of a file written by `write_map`.

    Raises ResultsError for a missing or damaged file and for one of another program or format.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as file:
            about = (file.metadata() or {}).get("torchslam")
            tensors: dict[str, Tensor] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise ResultsError(f"{path}: no map file") from None
    except (OSError, SafetensorError) as error:
        raise ResultsError(f"{path}: not a readable safetensors file: {error}") from None
    if about is None:
        raise ResultsError(f"{path}: a safetensors file, but not a torchslam map")
    described = json.loads(about)
    if described["format"] != FORMAT:
        raise ResultsError(f"{path}: map format {described['format']}, this version reads format {FORMAT}")
    slam_map = Map()
    for name, table in (("points", slam_map.points), ("keyframes", slam_map.keyframes)):
        columns = {
            key.removeprefix(f"{name}."): value
            for key, value in tensors.items()
            if key.startswith(f"{name}.")
        }
        if columns:
            table.append(**columns)
    width, height = described["camera"]["size"]
    return slam_map, Camera(described["camera"]["model"], tensors["camera.params"], (width, height))
