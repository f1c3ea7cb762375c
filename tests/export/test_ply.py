from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from torchslam.export.ply import CAMERA_COLOUR, VERTEX, write_ply


def test_points_and_cameras_read_back(tmp_path: Path, generator: torch.Generator) -> None:
    points_w = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    normals_w = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    centres_w = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    observations = torch.tensor([2, 3, 5, 10, 40])
    write_ply(tmp_path / "map.ply", points_w, normals_w, observations, centres_w)
    header, body = (tmp_path / "map.ply").read_bytes().split(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    assert lines[3:] == [
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "property int observations",
    ]
    vertices = np.frombuffer(body, VERTEX)
    positions = np.stack([vertices[name] for name in "xyz"], axis=1)
    np.testing.assert_allclose(positions, torch.cat([points_w, centres_w]).numpy(), rtol=1e-6)
    np.testing.assert_allclose(vertices["nz"][:5], normals_w[:, 2].numpy(), rtol=1e-6)
    assert vertices["observations"].tolist() == [2, 3, 5, 10, 40, 0, 0]
    assert [vertices[name][5] for name in ("red", "green", "blue")] == list(CAMERA_COLOUR)
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1)
    assert (colours[3] == colours[4]).all()  # ten and more look alike
    assert len(np.unique(colours[:4], axis=0)) == 4


def test_an_empty_cloud_has_a_header(tmp_path: Path) -> None:
    nothing = torch.zeros(0, 3)
    write_ply(tmp_path / "map.ply", nothing, nothing, torch.zeros(0), nothing)
    assert (tmp_path / "map.ply").read_bytes().endswith(b"end_header\n")
