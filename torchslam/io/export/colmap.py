"""COLMAP's files: a sparse model, binary and text, and the workspace of a dense reconstruction.

The formats: https://colmap.github.io/format.html. Identifiers begin at 1; the order is that of the frames and points. A
depth map is a line `width&height&channels&` and then float32 numbers, of which those along a row of the image are
neighbors, and channels come last.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.dense.cloud import PointCloud
from torchslam.dense.depth_maps import DepthMaps
from torchslam.geometry import Camera
from torchslam.geometry.transforms import corner_camera, corner_pixels, quaternion_wxyz
from torchslam.io.export.ply import write_cloud
from torchslam.io.export.scene import ExportedScene, Images, write_images

CAMERA_ID = 1  # number of the one camera; COLMAP counts from 1
MODEL_IDS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
"""COLMAP's numbers of camera models (src/colmap/sensor/models.h)."""


def colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's name of the camera's model and its parameters; every model has one that is exactly it."""
    params = corner_camera(camera).params.tolist()
    if camera.model == "pinhole":
        return "PINHOLE", params
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", params
    if not any(params[8:]):
        return "OPENCV", params[:8]
    return "FULL_OPENCV", [*params, 0.0, 0.0, 0.0][:12]  # k4, k5, k6: zero without a rational model


def write_colmap(folder: Path, scene: ExportedScene, names: Sequence[str] | None = None) -> None:
    """Write the model, binary and text, into a folder that is made if need be.

    Args:
        folder: of the files.
        scene: what is written.
        names: of the images of its frames; None: `scene.image_names`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    model, params = colmap_camera(scene.camera)
    camera = struct.pack(f"<IiQQ{len(params)}d", CAMERA_ID, MODEL_IDS[model], *scene.camera.size, *params)
    _write(folder / "cameras", [camera], [[CAMERA_ID, model, *scene.camera.size, *params]])
    frame, point = scene.frame_index.numpy(), scene.point_index.numpy()
    seen = np.zeros(len(frame), [("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
    seen["x"], seen["y"] = corner_pixels(scene.pixels).numpy().T
    seen["point"] = point + 1
    ends = np.bincount(frame, minlength=len(scene.T_cw)).cumsum()
    quaternions, translations = quaternion_wxyz(scene.T_cw[:, :3, :3]), scene.T_cw[:, :3, 3]
    poses = torch.cat((quaternions, translations), dim=1).tolist()
    binary, lines = list[bytes](), list[Iterable[Any]]()
    for number, (name, pose, points) in enumerate(
        zip(names or scene.image_names, poses, np.split(seen, ends)[:-1], strict=True), 1
    ):
        header = struct.pack("<I7dI", number, *pose, CAMERA_ID) + name.encode() + b"\0"
        binary.append(header + struct.pack("<Q", len(points)) + points.tobytes())
        lines += [[number, *pose, CAMERA_ID, name], chain.from_iterable(points.tolist())]
    _write(folder / "images", binary, lines)
    # Which image, and the how many-th of its points.
    tracks = np.zeros(len(frame), [("image", "<u4"), ("index", "<u4")])
    tracks["image"] = frame + 1
    tracks["index"] = np.arange(len(frame)) - np.searchsorted(frame, np.arange(len(scene.T_cw)))[frame]
    ends = np.bincount(point, minlength=len(scene.points_w)).cumsum()
    per_point = np.split(tracks[np.argsort(point, kind="stable")], ends)[:-1]
    columns = (scene.points_w.tolist(), scene.colors.tolist(), scene.point_errors().tolist(), per_point)
    binary, lines = [], []
    for number, (position, color, error, track) in enumerate(zip(*columns, strict=True), 1):
        header = struct.pack("<Q3d3BdQ", number, *position, *color, error, len(track))
        binary.append(header + track.tobytes())
        lines.append([number, *position, *color, error, *chain.from_iterable(track.tolist())])
    _write(folder / "points3D", binary, lines)


def _write(path: Path, binary: list[bytes], lines: Iterable[Iterable[Any]]) -> None:
    """Write a file of entries, and the same as text that reads back as the same numbers."""
    path.with_suffix(".bin").write_bytes(struct.pack("<Q", len(binary)) + b"".join(binary))
    text = "".join(" ".join(map(str, line)) + "\n" for line in lines)
    path.with_suffix(".txt").write_text(text, encoding="utf-8")


def write_workspace(
    folder: Path, scene: ExportedScene, path: Path, cloud: PointCloud | None, images: Images | None
) -> None:
    """Write COLMAP's workspace of a dense reconstruction, as after `patch_match_stereo` and `stereo_fusion`.

    Args:
        folder: the workspace, created if missing.
        scene: the frames of the depth maps, for their camera.
        path: the file of the depth maps.
        cloud: the fused cloud in the map's world, if there is one.
        images: of the size of the depth maps; None: no images.
    """
    stereo, names = folder / "stereo", dict(zip(scene.frame_ids.tolist(), scene.image_names, strict=True))
    for kind in ("depth_maps", "normal_maps", "consistency_graphs"):
        (stereo / kind).mkdir(parents=True, exist_ok=True)
        for old in (stereo / kind).glob("[0-9]" * 6 + ".png.*"):
            old.unlink()
    for maps in DepthMaps.blocks(path, 1):
        name = f"{names[int(maps.frame_index)]}.geometric.bin"
        (stereo / "depth_maps" / name).write_bytes(colmap_map(maps.depth))
        (stereo / "normal_maps" / name).write_bytes(colmap_map(maps.normal[0]))
    (stereo / "fusion.cfg").write_text("".join(f"{name}\n" for name in names.values()), encoding="utf-8")
    # COLMAP's default: a depth map is compared with 20 images.
    neighbors = "".join(f"{name}\n__auto__, 20\n" for name in names.values())
    (stereo / "patch-match.cfg").write_text(neighbors, encoding="utf-8")
    write_colmap(folder / "sparse", scene)
    if images is not None:
        write_images(folder / "images", scene, images)
    if cloud is not None:
        write_cloud(folder / "fused.ply", cloud)


def colmap_map(values: Float[Tensor, "C H W"]) -> bytes:
    """Encode a map as COLMAP does: the numbers of a row are neighbors, then rows, then channels."""
    channels, height, width = values.shape
    return f"{width}&{height}&{channels}&".encode() + values.cpu().numpy().astype("<f4").tobytes()
