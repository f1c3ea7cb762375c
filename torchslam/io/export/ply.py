"""Point clouds: binary PLY, read by MeshLab, CloudCompare, Blender and Open3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchslam.geometry import se3_inverse
from torchslam.geometry.transforms import upright_rotation
from torchslam.map.map import Map
from torchslam.system.run import keyframe_rows

VERTEX = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue")),
        ("observations", "<f4"),  # COLMAP refuses a file with integers of more than a byte
    ]
)
PROPERTY_TYPES = {"<f4": "float", "|u1": "uchar"}
CAMERA_COLOR = (213, 73, 63)


def write_map_cloud(path: str | Path, slam_map: Map, session: int) -> None:
    """Write the points of a map in the colors of the images, and the keyframes of a session in red, z up."""
    if slam_map.num_keyframes == 0:
        nothing = torch.zeros(0, 3)
        write_ply(path, nothing, nothing.byte(), nothing)
        return
    T_wc, points, alive = se3_inverse(slam_map.T_cw), slam_map.points, slam_map.valid_points()
    R_up = upright_rotation(T_wc)
    write_ply(
        path,
        slam_map.positions_w[alive] @ R_up.mT,
        points["colors"][alive],
        T_wc[keyframe_rows(slam_map, session), :3, 3] @ R_up.mT,
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
    vertices = np.zeros(len(points_w) + len(centers_w), VERTEX)
    points, cameras = vertices[: len(points_w)], vertices[len(points_w) :]
    for names, rows, values in (
        (("x", "y", "z"), points, points_w),
        (("red", "green", "blue"), points, colors),
        (("nx", "ny", "nz"), points, normals_w),
        (("x", "y", "z"), cameras, centers_w),
    ):
        if values is not None:
            for name, column in zip(names, values.detach().cpu().numpy().T, strict=True):
                rows[name] = column
    if observations is not None:
        points["observations"] = observations.detach().cpu().numpy()
    for name, value in zip(("red", "green", "blue"), CAMERA_COLOR, strict=True):
        cameras[name] = value
    Path(path).write_bytes(_header(len(vertices)) + vertices.tobytes())


def _header(count: int) -> bytes:
    properties = [f"property {PROPERTY_TYPES[VERTEX[name].str]} {name}" for name in VERTEX.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header"]
    return ("\n".join(lines) + "\n").encode("ascii")
