"""Point clouds for other programs: binary PLY, read by MeshLab, CloudCompare, Blender and Open3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

VERTEX = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue")),
        ("observations", "<i4"),
    ]
)
PROPERTY_TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}
CAMERA_COLOUR = (213, 73, 63)
# From seen twice to seen by ten keyframes and more: violet over teal to yellow.
FEW, SOME, MANY = np.array([68, 57, 131]), np.array([38, 150, 138]), np.array([235, 210, 80])


def write_ply(
    path: str | Path, points_w: Tensor, normals_w: Tensor, observations: Tensor, centres_w: Tensor
) -> None:
    """Write points and camera centres as one cloud.

    points_w, normals_w: (L, 3); the normal of a point looks back to the cameras that saw it
    observations:        (L,) in how many keyframes a point was seen: the colour and a property of their own
    centres_w:           (K, 3) camera centres, red, with 0 observations
    """
    vertices = np.zeros(len(points_w) + len(centres_w), VERTEX)
    points, cameras = vertices[: len(points_w)], vertices[len(points_w) :]
    for names, rows, values in (
        ("xyz", points, points_w),
        (("nx", "ny", "nz"), points, normals_w),
        ("xyz", cameras, centres_w),
    ):
        for name, column in zip(names, values.detach().cpu().numpy().T, strict=True):
            rows[name] = column
    counts = observations.detach().cpu().numpy()
    points["observations"] = counts
    for channel, name in enumerate(("red", "green", "blue")):
        stops = (FEW[channel], SOME[channel], MANY[channel])
        points[name] = np.interp(counts, (2, 5, 10), stops).round()
        cameras[name] = CAMERA_COLOUR[channel]
    Path(path).write_bytes(_header(len(vertices)) + vertices.tobytes())


def _header(count: int) -> bytes:
    properties = [f"property {PROPERTY_TYPES[VERTEX[name].str]} {name}" for name in VERTEX.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header"]
    return ("\n".join(lines) + "\n").encode("ascii")
