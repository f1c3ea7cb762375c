"""Point clouds: binary PLY, read by MeshLab, CloudCompare, Blender and Open3D.

The sparse cloud of a map is only written. The dense one is read again, by `torchslam plot` and `torchslam export`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchslam.dense.cloud import PointCloud
from torchslam.errors import ResultsError
from torchslam.geometry import se3_inverse
from torchslam.geometry.transforms import upright_rotation
from torchslam.map.map import Map
from torchslam.map.unit import MetricUnit
from torchslam.utils.files import read_bytes, write_whole

POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
COLORED = [*((name, "<f4") for name in POSITION + NORMAL), *((name, "u1") for name in COLOR)]
# COLMAP refuses a file with integers of more than a byte.
VERTEX = np.dtype([*COLORED, ("observations", "<f4")])
DENSE_VERTEX = np.dtype([*COLORED, ("confidence", "<f4")])
CAMERA_COLOR = (213, 73, 63)  # red, green, blue of the trajectory in the cloud
MAX_DRAWN = 500_000  # of a dense cloud that a program draws, or starts a splat from
MAX_BYTES = 1 << 33  # of a cloud that is read: 270 million points


def upright_from_map(slam_map: Map, unit: MetricUnit | None = None) -> Float[Tensor, "3 3"]:
    """Rotation from the world of a map to the upright one of all exports, float64; none if its unit knows gravity."""
    T_wc = se3_inverse(slam_map.T_cw).double()
    if unit is not None and unit.is_level:
        return torch.eye(3, dtype=T_wc.dtype, device=T_wc.device)
    return upright_rotation(T_wc)


def write_map_cloud(path: str | Path, slam_map: Map, session: int, unit: MetricUnit | None = None) -> None:
    """Write the points of a map in the colors of the images, and the keyframes of a session in red, z up."""
    if slam_map.num_keyframes == 0:
        nothing = torch.zeros(0, 3, dtype=torch.float32, device="cpu")
        write_ply(path, nothing, nothing.byte(), nothing)
        return
    T_wc, points, alive = se3_inverse(slam_map.T_cw), slam_map.points, slam_map.valid_points()
    R_up = upright_from_map(slam_map, unit).to(T_wc)
    write_ply(
        path,
        slam_map.positions_w[alive] @ R_up.mT,
        points["colors"][alive],
        T_wc[slam_map.keyframe_rows(session), :3, 3] @ R_up.mT,
        -points["view_directions_w"][alive] @ R_up.mT,
        points["times_observed"][alive],
    )


def write_ply(
    path: str | Path,
    points_w: Float[Tensor, "N 3"],
    colors: UInt8[Tensor, "N 3"],
    centers_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "N 3"] | None = None,
    observations: Int[Tensor, " N"] | None = None,
) -> None:
    """Write points and camera centers as one cloud.

    Args:
        path: the file.
        points_w: points.
        colors: red, green, blue.
        centers_w: camera centers, drawn red, with 0 observations.
        normals_w: direction from each point to the cameras that observed it; None: zero.
        observations: number of keyframes that observe each point; None: 0.
    """
    red = torch.tensor(CAMERA_COLOR, dtype=torch.uint8, device=colors.device).expand(len(centers_w), 3)
    nothing, none = torch.zeros_like(centers_w), centers_w.new_zeros(len(centers_w))
    columns = (
        torch.cat((points_w, centers_w)),
        torch.cat((torch.zeros_like(points_w) if normals_w is None else normals_w, nothing)),
        torch.cat((colors, red)),
        torch.cat((points_w.new_zeros(len(points_w)) if observations is None else observations, none)),
    )
    _write(path, VERTEX, *columns)


def write_cloud(path: str | Path, cloud: PointCloud, R: Float[Tensor, "3 3"] | None = None) -> None:
    """Write a dense cloud, atomically; equal clouds give equal bytes.

    Args:
        path: the file.
        cloud: points of the map's world.
        R: rotation from the map's world to that of the file, as `upright_from_map`; None: the same.
    """
    cloud = cloud if R is None else cloud.turned(R)
    _write(path, DENSE_VERTEX, cloud.points_w, cloud.normals_w, cloud.colors, cloud.confidence)


def read_cloud(path: str | Path, R: Float[Tensor, "3 3"] | None = None) -> PointCloud:
    """Read and check a file that `write_cloud` wrote.

    Args:
        path: the file.
        R: the rotation that the file was written with.

    Raises:
        ResultsError: the file is missing, too large, damaged, or another kind of PLY file.
    """
    try:
        content = read_bytes(path, MAX_BYTES, "a dense cloud")
    except FileNotFoundError:
        raise ResultsError(f"{path}: no dense cloud") from None
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        cloud = _cloud(content)
    except ValueError as error:
        raise ResultsError(f"{path}: not a dense cloud of torchslam: {error}") from None
    return cloud if R is None else cloud.turned(R.mT)


def _cloud(content: bytes) -> PointCloud:
    """The cloud of a file. Raises ValueError for any other content and for impossible numbers."""
    found = re.match(rb"ply\nformat binary_little_endian 1\.0\nelement vertex (\d{1,10})\n", content)
    if found is None:
        raise ValueError("no header of a binary PLY file")
    count = int(found[1])
    header = _header(DENSE_VERTEX, count)
    if not content.startswith(header):
        raise ValueError(f"its properties are not {', '.join(DENSE_VERTEX.names or ())}")
    if len(content) != len(header) + count * DENSE_VERTEX.itemsize:
        raise ValueError(f"{count} points and a file of {len(content)} bytes")
    rows = np.frombuffer(content, DENSE_VERTEX, offset=len(header))
    columns = (np.stack([rows[name] for name in names], axis=1) for names in (POSITION, NORMAL, COLOR))
    cloud = PointCloud(*map(torch.from_numpy, (*columns, rows["confidence"].copy())))
    if not bool(torch.isfinite(cloud.points_w).all()):
        raise ValueError("positions are not finite")
    if not bool(((cloud.normals_w.norm(dim=-1) - 1).abs() < 1e-3).all()):
        raise ValueError("normals are not of unit length")
    if not bool(((cloud.confidence >= 0) & (cloud.confidence <= 1)).all()):
        raise ValueError("confidence is not between 0 and 1")
    return cloud


def _write(path: str | Path, types: np.dtype[np.void], *columns: Tensor) -> None:
    """Write the properties of a kind of vertex: columns of a property, or of three."""
    vertices = np.zeros(len(columns[0]), types)
    values = [row for column in columns for row in np.atleast_2d(column.detach().cpu().numpy().T)]
    for name, row in zip(types.names or (), values, strict=True):
        vertices[name] = row
    write_whole(path, [_header(types, len(vertices)), vertices.tobytes()])


def _header(types: np.dtype[np.void], count: int) -> bytes:
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {kinds[types[name].str]} {name}" for name in types.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header"]
    return ("\n".join(lines) + "\n").encode("ascii")
