from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from torchslam.dense.cloud import PointCloud
from torchslam.errors import ResultsError
from torchslam.geometry import rigid, se3_inverse, so3_exp
from torchslam.io.export.ply import CAMERA_COLOR, VERTEX, read_cloud, write_cloud, write_map_cloud, write_ply
from torchslam.map.map import Map


def read(path: Path) -> np.ndarray:
    return np.frombuffer(path.read_bytes().split(b"end_header\n", 1)[1], VERTEX)


def columns(vertices: np.ndarray, *names: str) -> np.ndarray:
    return np.stack([vertices[name] for name in names], axis=1)


def test_points_and_cameras_read_back(tmp_path: Path, generator: torch.Generator) -> None:
    points_w = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    normals_w = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    centers_w = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    colors = torch.randint(0, 256, (5, 3), generator=generator, dtype=torch.uint8)
    observations = torch.tensor([2, 3, 5, 10, 40])
    write_ply(tmp_path / "map.ply", points_w, colors, centers_w, normals_w, observations)
    header = (tmp_path / "map.ply").read_bytes().split(b"end_header\n")[0]
    lines = header.decode("ascii").splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    assert lines[3:] == [
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "property float observations",
    ]
    vertices = read(tmp_path / "map.ply")
    positions = columns(vertices, "x", "y", "z")
    np.testing.assert_allclose(positions, torch.cat([points_w, centers_w]).numpy(), rtol=1e-6)
    np.testing.assert_allclose(columns(vertices, "nx", "ny", "nz")[:5], normals_w.numpy(), rtol=1e-6)
    assert vertices["observations"].tolist() == [2, 3, 5, 10, 40, 0, 0]
    seen = columns(vertices, "red", "green", "blue")
    np.testing.assert_array_equal(seen[:5], colors.numpy())
    assert seen[5:].tolist() == [list(CAMERA_COLOR)] * 2


def test_a_map_is_rotated_upright(tmp_path: Path, slam_map: Map) -> None:
    """By a rotation alone: up for the cameras is z, normals look at the observer as before."""
    slam_map.points["colors"][:] = torch.arange(len(slam_map.points))[:, None].to(torch.uint8)
    slam_map.keyframes["session"][4:] = 1
    write_map_cloud(tmp_path / "map.ply", slam_map, session=0)
    vertices, alive = read(tmp_path / "map.ply"), slam_map.valid_points()
    points, cameras = vertices[: len(alive)], vertices[len(alive) :]
    assert points["red"].tolist() == alive.tolist()
    assert points["observations"].tolist() == slam_map.points["times_observed"][alive].tolist()
    R = torch.tensor(
        ((1, 0, 0), (0, 0, 1), (0, -1, 0)), dtype=torch.float64
    )  # y points down in the small run
    for names, expected in (
        (("x", "y", "z"), slam_map.positions_w[alive]),
        (("nx", "ny", "nz"), -slam_map.points["view_directions_w"][alive]),
    ):
        np.testing.assert_allclose(columns(points, *names), expected @ R.mT, atol=1e-5)
    centers_w = se3_inverse(slam_map.T_cw)[:4, :3, 3]
    np.testing.assert_allclose(columns(cameras, "x", "y", "z"), centers_w @ R.mT, atol=1e-6)


def test_the_upright_map_does_not_depend_on_the_map_frame(tmp_path: Path, slam_map: Map) -> None:
    write_map_cloud(tmp_path / "before.ply", slam_map, session=0)
    turn = rigid(so3_exp(torch.tensor((0.4, 1.0, -2.0), dtype=torch.float64)), torch.zeros(3).double())
    slam_map.keyframes["T_cw"][:] = slam_map.T_cw @ se3_inverse(turn)
    slam_map.points["positions_w"][:] = slam_map.positions_w @ turn[:3, :3].mT
    write_map_cloud(tmp_path / "after.ply", slam_map, session=0)
    before, after = read(tmp_path / "before.ply"), read(tmp_path / "after.ply")
    np.testing.assert_allclose(after["z"], before["z"], atol=1e-5)


def test_an_empty_map_has_a_header(tmp_path: Path) -> None:
    write_map_cloud(tmp_path / "map.ply", Map(), session=0)
    assert (tmp_path / "map.ply").read_bytes().endswith(b"end_header\n")


# --- the dense cloud -----------------------------------------------------------------------------------------


@pytest.fixture
def cloud(generator: torch.Generator) -> PointCloud:
    normals_w = torch.nn.functional.normalize(torch.randn(7, 3, generator=generator), dim=-1)
    return PointCloud(
        points_w=torch.randn(7, 3, generator=generator),
        normals_w=normals_w,
        colors=torch.randint(0, 256, (7, 3), generator=generator, dtype=torch.uint8),
        confidence=torch.rand(7, generator=generator),
    )


def test_a_dense_cloud_round_trips(tmp_path: Path, cloud: PointCloud) -> None:
    write_cloud(tmp_path / "dense.ply", cloud)
    again = read_cloud(tmp_path / "dense.ply")
    for name in ("points_w", "normals_w", "colors", "confidence"):
        assert torch.equal(getattr(again, name), getattr(cloud, name)), name
    write_cloud(tmp_path / "again.ply", again)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dense.ply").read_bytes()


def test_a_dense_cloud_is_turned_and_turned_back(tmp_path: Path, cloud: PointCloud) -> None:
    R = so3_exp(torch.tensor((0.4, 1.0, -2.0), dtype=torch.float64))
    write_cloud(tmp_path / "dense.ply", cloud, R)
    upright = read_cloud(tmp_path / "dense.ply")
    for turned, before in ((upright.points_w, cloud.points_w), (upright.normals_w, cloud.normals_w)):
        torch.testing.assert_close(turned, before @ R.float().mT)
    torch.testing.assert_close(read_cloud(tmp_path / "dense.ply", R).points_w, cloud.points_w)


def test_another_program_reads_both_clouds(tmp_path: Path, cloud: PointCloud) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    write_cloud(tmp_path / "dense.ply", cloud)
    write_ply(tmp_path / "map.ply", cloud.points_w, cloud.colors, torch.zeros(0, 3))
    for name in ("dense.ply", "map.ply"):
        made = pycolmap.Reconstruction()
        made.import_PLY(str(tmp_path / name))
        assert len(made.points3D) == len(cloud)
        for number, point in made.points3D.items():
            np.testing.assert_array_equal(point.xyz, cloud.points_w[number - 1])
            np.testing.assert_array_equal(point.color, cloud.colors[number - 1])


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"ply", b"pig", "no header"),
        (b"vertex 7", b"vertex 70000000000000", "no header"),
        (b"vertex 7", b"vertex 8", "8 points and a file of"),
        (b"float confidence", b"float observations", "its properties are not x, y"),
        (b"uchar red", b"float red", "its properties are not x, y"),
    ],
)
def test_a_damaged_header_is_reported(
    tmp_path: Path, cloud: PointCloud, old: bytes, new: bytes, reason: str
) -> None:
    path = tmp_path / "dense.ply"
    write_cloud(path, cloud)
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(ResultsError, match=f"dense.ply: .*{reason}"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("points_w", torch.nan, "positions are not finite"),
        ("normals_w", 3.0, "normals are not of unit length"),
        ("confidence", 1.5, "confidence is not between 0 and 1"),
        ("confidence", torch.nan, "confidence is not between 0 and 1"),
    ],
)
def test_impossible_numbers_are_reported(
    tmp_path: Path, cloud: PointCloud, name: str, value: float, reason: str
) -> None:
    getattr(cloud, name)[3] = value
    write_cloud(tmp_path / "dense.ply", cloud)
    with pytest.raises(ResultsError, match=reason):
        read_cloud(tmp_path / "dense.ply")


def test_a_missing_cloud_and_a_folder_are_reported(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="no dense cloud"):
        read_cloud(tmp_path / "dense.ply")
    with pytest.raises(ResultsError, match="cannot be read: Is a directory"):
        read_cloud(tmp_path)
