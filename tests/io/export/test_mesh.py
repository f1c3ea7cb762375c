"""A mesh of a room with exact depth, by Open3D."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.box_room import HALF, box_depths
from tests.io.export.test_depths import SMALL
from torchslam.errors import ResultsError
from torchslam.geometry import rigid, so3_exp
from torchslam.io.export.mesh import write_mesh

R_UP = so3_exp(torch.tensor((torch.pi / 2, 0.0, 0.0), dtype=torch.float64))


@pytest.fixture
def depths(tmp_path: Path) -> Path:
    """Of four cameras that look around; a corner of each map has little confidence and wrong depth."""
    turns = torch.linspace(0.0, 1.2, 4, dtype=torch.float64)
    zero = torch.zeros_like(turns)
    T_cw = rigid(so3_exp(torch.stack((zero, turns, zero), dim=-1)), torch.zeros(4, 3, dtype=torch.float64))
    maps = box_depths(T_cw, torch.arange(4), SMALL)
    maps.depth[:, :10, :10] *= 0.5
    maps.confidence[:, :10, :10] = 0.2
    maps.save(tmp_path / "depths.safetensors")
    return tmp_path / "depths.safetensors"


def test_the_mesh_lies_on_the_walls(depths: Path, tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d", reason="Open3D is not installed: pip install 'torchslam[mesh]'")
    size = write_mesh(tmp_path / "mesh.ply", depths, R_UP, None)
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    assert (len(mesh.vertices), len(mesh.triangles)) == (size.vertices, size.triangles)
    assert size.triangles > 500
    points = np.asarray(mesh.vertices) @ R_UP.numpy()  # of the map
    off = np.abs(np.abs(points).max(axis=1) - HALF)
    assert np.median(off) < 0.2 * size.voxel
    assert (off < size.voxel).mean() > 0.99
    inward = -(np.asarray(mesh.vertex_normals) @ R_UP.numpy() * points).sum(axis=1)
    assert (inward > 0).mean() > 0.99
    assert np.asarray(mesh.vertex_colors).std() < 0.01  # gray without images
    write_mesh(tmp_path / "again.ply", depths, R_UP, None)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "mesh.ply").read_bytes()


def test_depth_without_confidence_gives_no_mesh(depths: Path, tmp_path: Path) -> None:
    pytest.importorskip("open3d", reason="Open3D is not installed: pip install 'torchslam[mesh]'")
    maps = box_depths(torch.eye(4, dtype=torch.float64)[None], torch.tensor([0]), SMALL)
    replace(maps, confidence=0.1 * maps.confidence).save(depths)
    with pytest.raises(ResultsError, match=r"no depth of a confidence of 0\.5 or more"):
        write_mesh(tmp_path / "mesh.ply", depths, R_UP, None)
