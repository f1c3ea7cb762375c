"""A sparse model in COLMAP's files, binary and text: cameras, images, points3D.

The formats: https://colmap.github.io/format.html. Identifiers begin at 1; the order is that of the frames and points.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchslam.geometry import Camera
from torchslam.geometry.transforms import corner_camera, corner_pixels, quaternion_wxyz
from torchslam.io.export.scene import ExportedScene

CAMERA_ID = 1
"""Number of the one camera; COLMAP counts from 1."""
MODEL_IDS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
"""COLMAP's numbers of camera models (src/colmap/sensor/models.h)."""
POINT_IN_IMAGE = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
TRACK = np.dtype([("image", "<u4"), ("index", "<u4")])  # which image, and the how many-th of its points


@dataclass(frozen=True)
class _Image:
    """pose: quaternion w first, translation, world to camera; points: of POINT_IN_IMAGE."""

    name: str
    pose: list[float]
    points: np.ndarray


@dataclass(frozen=True)
class _Point:
    """track: of TRACK."""

    position: list[float]
    color: list[int]
    error: float
    track: np.ndarray


def colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's name of the camera's model and its parameters; every model has one that is exactly it."""
    params = corner_camera(camera).params.tolist()
    if camera.model == "pinhole":
        return "PINHOLE", params
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", params
    if not any(params[8:]):
        return "OPENCV", params[:8]
    return "FULL_OPENCV", [*params, 0.0, 0.0, 0.0][
        :12
    ]  # k4, k5, k6 of a denominator are zero without a rational model


def write_colmap(folder: Path, scene: ExportedScene) -> None:
    """Write the model, binary and text, into a folder that is made if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    images, points = _images(scene), _points(scene)
    (folder / "cameras.bin").write_bytes(_binary_camera(scene.camera))
    (folder / "images.bin").write_bytes(_counted(_binary_image(*item) for item in enumerate(images, 1)))
    (folder / "points3D.bin").write_bytes(_counted(_binary_point(*item) for item in enumerate(points, 1)))
    model, params = colmap_camera(scene.camera)
    lines = {
        "cameras.txt": [_line(CAMERA_ID, model, *scene.camera.size, *params)],
        "images.txt": [_text_image(*item) for item in enumerate(images, 1)],
        "points3D.txt": [_text_point(*item) for item in enumerate(points, 1)],
    }
    for name, content in lines.items():
        (folder / name).write_text("".join(content), encoding="utf-8")


def _images(scene: ExportedScene) -> list[_Image]:
    points = np.zeros(len(scene.pixels), POINT_IN_IMAGE)
    points["x"], points["y"] = corner_pixels(scene.pixels).numpy().T
    points["point"] = scene.point_index.numpy() + 1
    counts = np.bincount(scene.frame_index.numpy(), minlength=len(scene.T_cw))
    per_image = np.split(points, counts.cumsum())[:-1]  # the rest is empty
    quaternions = quaternion_wxyz(scene.T_cw[:, :3, :3]).tolist()
    poses = [q + t for q, t in zip(quaternions, scene.T_cw[:, :3, 3].tolist(), strict=True)]
    return [_Image(*row) for row in zip(scene.image_names, poses, per_image, strict=True)]


def _points(scene: ExportedScene) -> list[_Point]:
    frame, point = scene.frame_index.numpy(), scene.point_index.numpy()
    first = np.searchsorted(frame, np.arange(len(scene.T_cw)))
    tracks = np.zeros(len(frame), TRACK)
    tracks["image"], tracks["index"] = frame + 1, np.arange(len(frame)) - first[frame]
    ends = np.bincount(point, minlength=len(scene.points_w)).cumsum()
    per_point = np.split(tracks[np.argsort(point, kind="stable")], ends)[:-1]
    columns = (scene.points_w.tolist(), scene.colors.tolist(), scene.point_errors().tolist(), per_point)
    return [_Point(*row) for row in zip(*columns, strict=True)]


def _counted(items: Iterable[bytes]) -> bytes:
    parts = list(items)
    return struct.pack("<Q", len(parts)) + b"".join(parts)


def _binary_camera(camera: Camera) -> bytes:
    model, params = colmap_camera(camera)
    header = struct.pack("<IiQQ", CAMERA_ID, MODEL_IDS[model], *camera.size)
    return _counted([header + struct.pack(f"<{len(params)}d", *params)])


def _binary_image(number: int, image: _Image) -> bytes:
    header = struct.pack("<I7dI", number, *image.pose, CAMERA_ID) + image.name.encode() + b"\0"
    return header + struct.pack("<Q", len(image.points)) + image.points.tobytes()


def _binary_point(number: int, point: _Point) -> bytes:
    header = struct.pack("<Q3d3BdQ", number, *point.position, *point.color, point.error, len(point.track))
    return header + point.track.tobytes()


def _text_image(number: int, image: _Image) -> str:
    """Two lines: the pose, and the points, which may be none."""
    points = [value for point in image.points.tolist() for value in point]
    return _line(number, *image.pose, CAMERA_ID, image.name) + _line(*points)


def _text_point(number: int, point: _Point) -> str:
    track = [value for seen in point.track.tolist() for value in seen]
    return _line(number, *point.position, *point.color, point.error, *track)


def _line(*values: Any) -> str:
    """Values as text that reads back as the same numbers."""
    return " ".join(map(str, values)) + "\n"
