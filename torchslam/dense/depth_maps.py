"""Depth maps of keyframes, and their file: one safetensors file that is written and read in blocks.

The file holds a tensor for each field of `DepthMaps`, so that any program reads it. Depth maps are large: `join` copies
the files of single keyframes into one, and `DepthMaps.blocks` reads a few keyframes at a time.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.utils.files import check_regular, parse_json
from torchslam.utils.tensor_file import TYPES, Blocks, write_tensors

FORMAT = 1
"""Number of the file format."""
FIELDS = {
    "frame_index": torch.int64,
    "depth": torch.float32,
    "normal": torch.float32,
    "confidence": torch.float32,
    "T_cw": torch.float64,
}
"""Tensors of the file that have a row per keyframe, and their types."""
CAMERA = "camera.params"


@dataclass(frozen=True)
class DepthMaps:
    """Depth of keyframes, or of other frames with a pose.

    Attributes:
        frame_index: frames in the sequence, ascending.
        depth: z in the camera frame, map units; 0 where unknown.
        normal: unit normals in the camera frame, facing the camera; 0 where unknown.
        confidence: probability, 0 to 1, that the depth is right within 5 %; 0 where unknown.
        T_cw: poses.
        camera: a pinhole of the size of the maps; undistorted images belong to it.
    """

    frame_index: Int[Tensor, " K"]
    depth: Float[Tensor, "K H W"]
    normal: Float[Tensor, "K 3 H W"]
    confidence: Float[Tensor, "K H W"]
    T_cw: Float[Tensor, "K 4 4"]
    camera: Camera

    def __len__(self) -> int:
        return len(self.frame_index)

    def save(self, path: str | Path, about: dict[str, Any] | None = None) -> None:
        """Write all maps to a file, atomically; equal maps give equal bytes.

        Args:
            path: the file.
            about: what a program wants to know again (`read_about`), as JSON.
        """
        columns = {name: getattr(self, name) for name in FIELDS}
        blocks = {name: Blocks(FIELDS[name], tuple(rows.shape), [rows]) for name, rows in columns.items()}
        _write(path, blocks, self.camera, about or {})

    @classmethod
    def load(cls, path: str | Path) -> DepthMaps:
        """Read and check all maps of a file. Raises ResultsError naming the file."""
        return cls._read(path, slice(None))

    @classmethod
    def blocks(cls, path: str | Path, size: int = 8) -> Iterator[DepthMaps]:
        """Read and check a file in blocks of keyframes, for files larger than memory. Raises ResultsError."""
        count = read_shape(path)[0]
        for start in range(0, count, size):
            yield cls._read(path, slice(start, start + size))

    @classmethod
    def _read(cls, path: str | Path, rows: slice) -> DepthMaps:
        with _opened(path) as (file, about):
            # In memory of their own: the file may be replaced.
            columns = {name: file.get_slice(name)[rows].clone() for name in FIELDS}
            maps = cls(**columns, camera=_camera(file, about))
            maps._check()
        return maps

    def _check(self) -> None:
        """Check the numbers. Raises ValueError."""
        for name in ("depth", "normal", "confidence", "T_cw"):
            if not bool(torch.isfinite(getattr(self, name)).all()):
                raise ValueError(f"{name}: not finite")
        if not bool(torch.isfinite(self.camera.params).all() and (self.camera.params[:2] > 0).all()):
            raise ValueError(f"{CAMERA}: no focal lengths and principal point")
        lengths = self.normal.norm(dim=1)
        for is_wrong, what in (
            (
                (self.frame_index.diff(prepend=self.frame_index.new_tensor([-1])) <= 0),
                "frame_index: not ascending",
            ),
            ((self.depth < 0), "depth: negative"),
            ((self.confidence < 0) | (self.confidence > 1), "confidence: not between 0 and 1"),
            ((lengths - 1).abs().minimum(lengths) > 1e-3, "normal: neither of unit length nor 0"),
        ):
            if bool(is_wrong.any()):
                raise ValueError(what)


def read_shape(path: str | Path) -> tuple[int, int, int]:
    """Read the number of keyframes, height and width of a file. Raises ResultsError naming the file."""
    with _opened(path) as (file, _):
        count, height, width = file.get_slice("depth").get_shape()
        return count, height, width


def read_frames(path: str | Path) -> tuple[Int[Tensor, " K"], Camera]:
    """Read which frames a file has maps of, and their camera, without the maps. Raises ResultsError."""
    with _opened(path) as (file, about):
        return file.get_tensor("frame_index").clone(), _camera(file, about)


def read_about(path: str | Path) -> dict[str, Any]:
    """Read what was given to `DepthMaps.save` as `about`. Raises ResultsError naming the file."""
    with _opened(path) as (_, about):
        return dict(about["about"])


def join(path: str | Path, parts: Sequence[str | Path]) -> None:
    """Write the maps of several files, in their order, as one, reading them one at a time.

    Args:
        path: the file to write.
        parts: files of `DepthMaps.save`, of one camera and size; at least one.

    Raises:
        ResultsError: a part is missing or damaged, or has another camera.
        OSError: the file cannot be written.
    """
    camera, count, shapes = None, 0, {}
    for part in parts:
        maps = DepthMaps.load(part)
        camera = maps.camera if camera is None else camera
        if maps.camera.size != camera.size or not torch.equal(maps.camera.params, camera.params):
            raise ResultsError(f"{part}: depth maps of another camera than {parts[0]}")
        count += len(maps)
        shapes = {name: (count, *getattr(maps, name).shape[1:]) for name in FIELDS}
    if camera is None:
        raise ValueError("no depth maps to join")

    def rows(name: str) -> Iterator[Tensor]:
        for part in parts:
            with _opened(part) as (file, _):
                yield file.get_tensor(name)

    _write(path, {name: Blocks(FIELDS[name], shapes[name], rows(name)) for name in FIELDS}, camera, {})


def _write(path: str | Path, blocks: dict[str, Blocks], camera: Camera, about: dict[str, Any]) -> None:
    """Write the columns of depth maps."""
    params = camera.params.double()
    description = {
        "format": FORMAT,
        "camera": {"model": camera.model, "size": list(camera.size)},
        "about": about,
    }
    write_tensors(path, {**blocks, CAMERA: params}, {"torchslam": json.dumps(description, sort_keys=True)})


@contextmanager
def _opened(path: str | Path) -> Iterator[tuple[Any, dict[str, Any]]]:
    """A file with the tensors of depth maps, and its description. Raises ResultsError."""
    from safetensors import SafetensorError, safe_open

    try:
        check_regular(path, 1 << 40, "depth maps")  # of 170,000 keyframes of 640 x 480 pixels
        with safe_open(str(path), framework="pt") as file:
            about = parse_json((file.metadata() or {}).get("torchslam", "null"))
            if not isinstance(about, dict) or "format" not in about:
                raise ResultsError(f"{path}: a safetensors file, but not depth maps of torchslam")
            if about["format"] != FORMAT:
                raise ResultsError(
                    f"{path}: depth maps of format {about['format']}, this version reads format {FORMAT}: "
                    "run again"
                )
            _check_shapes(file, about)
            yield file, about
    except FileNotFoundError:
        raise ResultsError(f"{path}: no depth maps") from None
    except OSError as error:
        raise ResultsError(f"{path}: not readable depth maps: {error.strerror or error}") from None
    except (SafetensorError, ValueError, TypeError, KeyError, RuntimeError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ResultsError(f"{path}: not whole depth maps: {what}") from None


def _camera(file: Any, about: dict[str, Any]) -> Camera:
    width, height = about["camera"]["size"]
    return Camera(about["camera"]["model"], file.get_tensor(CAMERA).clone(), (width, height))


def _check_shapes(file: Any, about: dict[str, Any]) -> None:
    """Check names, shapes and types against each other and the camera. Raises ValueError."""
    wrong = sorted(set(file.keys()) ^ {*FIELDS, CAMERA})
    if wrong:
        raise ValueError(f"missing or unknown tensors: {', '.join(wrong[:3])}")
    width, height = about["camera"]["size"]
    if not all(type(side) is int and side > 0 for side in (width, height)):
        raise ValueError(f"an image of {width} x {height} pixels")
    if about["camera"]["model"] != "pinhole" or not isinstance(about["about"], dict):
        raise ValueError(f"the camera is {about['camera']['model']}, not a pinhole")
    (count,) = file.get_slice("frame_index").get_shape()[:1] or (0,)
    expected = {
        "frame_index": [count],
        "depth": [count, height, width],
        "normal": [count, 3, height, width],
        "confidence": [count, height, width],
        "T_cw": [count, 4, 4],
        CAMERA: [4],
    }
    for name, shape in expected.items():
        found, dtype = file.get_slice(name), TYPES[FIELDS.get(name, torch.float64)]
        if found.get_shape() != shape or found.get_dtype() != dtype:
            raise ValueError(f"{name}: {found.get_dtype()} {found.get_shape()}, expected {dtype} {shape}")
