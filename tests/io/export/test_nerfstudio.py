"""Points of the cloud fall on their keypoints by nerfstudio's formulas, which are written out here anew."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.box_room import HALF, box_cloud, box_depths
from tests.io.export.conftest import PointErrors, reprojection_error
from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.geometry.transforms import upright_rotation
from torchslam.io.export.nerfstudio import write_nerfstudio
from torchslam.io.export.ply import VERTEX
from torchslam.io.export.ply import read_cloud as read_dense
from torchslam.io.export.scene import ExportedScene, enlarged, undistorted


def distort(about: dict, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, k3, k4, p1, p2 = (about.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if about["camera_model"] == "OPENCV_FISHEYE":
        r = np.hypot(x, y)
        theta = np.arctan(r)
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        return x * bent / r, y * bent / r
    r2 = x * x + y * y
    d = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return d * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), d * y + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)


def read_cloud(path: Path) -> np.ndarray:
    return np.frombuffer(path.read_bytes().split(b"end_header\n", 1)[1], VERTEX)


@pytest.fixture
def folder(scene: ExportedScene, tmp_path: Path) -> Path:
    if scene.camera.model == "rational":
        pytest.skip("no model of nerfstudio holds it")
    write_nerfstudio(tmp_path, scene, upright_rotation(scene.T_wc))
    return tmp_path


@pytest.mark.parametrize("lens", ["rational"], indirect=True)
def test_a_model_that_nerfstudio_does_not_have_is_refused(scene: ExportedScene, tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="nerfstudio has no rational camera: export to colmap"):
        write_nerfstudio(tmp_path, scene, upright_rotation(scene.T_wc))


def test_points_fall_on_their_keypoints(scene: ExportedScene, folder: Path) -> None:
    about = json.loads((folder / "transforms.json").read_text())
    cloud = read_cloud(folder / about["ply_file_path"])
    points = np.stack([cloud[name] for name in "xyz"], axis=1).astype(float)
    errors = PointErrors(len(points))
    for row, frame in enumerate(about["frames"]):
        seen = (scene.frame_index == row).numpy()
        ids = scene.point_index.numpy()[seen]
        T_wc = np.array(frame["transform_matrix"])
        x, y, z = ((points[ids] - T_wc[:3, 3]) @ T_wc[:3, :3]).T
        x, y = distort(about, x / -z, -y / -z)
        u, v = about["fl_x"] * x + about["cx"], about["fl_y"] * y + about["cy"]
        # Of nerfstudio's pixel centers.
        errors.add(ids, np.stack((u, v), axis=1), scene.pixels.numpy()[seen] + 0.5)
    assert errors.mean() == pytest.approx(reprojection_error(scene), abs=1e-4)  # floats in the cloud


def test_the_map_is_upright_and_the_transform_is_written(scene: ExportedScene, folder: Path) -> None:
    about = json.loads((folder / "transforms.json").read_text())
    up = np.mean([np.array(frame["transform_matrix"])[:3, 1] for frame in about["frames"]], axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), (0, 0, 1), atol=1e-9)
    R = torch.tensor(about["upright_from_map"], dtype=torch.float64)
    torch.testing.assert_close(R, upright_rotation(scene.T_wc))
    assert "applied_transform" not in about  # versions of nerfstudio differ in what they apply it to


def test_the_cloud_has_the_colors_and_the_frames_their_images(scene: ExportedScene, folder: Path) -> None:
    about = json.loads((folder / "transforms.json").read_text())
    cloud = read_cloud(folder / "sparse_pc.ply")
    colors = np.stack([cloud[name] for name in ("red", "green", "blue")], axis=1)
    np.testing.assert_array_equal(colors, scene.colors)
    assert [frame["file_path"] for frame in about["frames"]] == [
        f"images/{name}" for name in scene.image_names
    ]
    assert (about["w"], about["h"]) == scene.camera.size


def test_depth_images_give_the_surfaces(scene: ExportedScene, tmp_path: Path) -> None:
    """As nerfstudio reads them: enlarged to the size of the images without interpolation, in thousandths."""
    small = Camera.pinhole(50.0, 52.5, 39.5, 29.5, size=(80, 60))
    maps = box_depths(scene.T_cw, scene.frame_ids, small)
    maps.save(tmp_path / "depths.safetensors")
    flat = undistorted(scene, enlarged(small, scene.camera).to(torch.float64))
    R_up, cloud = upright_rotation(scene.T_wc), box_cloud(maps)
    write_nerfstudio(tmp_path, flat, R_up, cloud, tmp_path / "depths.safetensors")
    about = json.loads((tmp_path / "transforms.json").read_text())
    assert (about["w"], about["h"]) == (320, 240)
    assert len(about["frames"]) == 4
    for frame in about["frames"]:
        image = cv2.imread(str(tmp_path / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        assert image.dtype == np.uint16
        depth = cv2.resize(image * 1e-3, (320, 240), interpolation=cv2.INTER_NEAREST)
        v, u = np.mgrid[:240, :320] + 0.5
        ray = np.stack(
            ((u - about["cx"]) / about["fl_x"], -(v - about["cy"]) / about["fl_y"], -np.ones_like(u)), -1
        )
        T_wc = np.array(frame["transform_matrix"])
        points = ((ray * depth[..., None]) @ T_wc[:3, :3].T + T_wc[:3, 3]) @ R_up.numpy()  # of the map
        far = np.abs(np.abs(points).max(axis=-1) - HALF)
        assert np.median(far) < 2e-3
        assert far.max() < 0.06  # in the other pixels of an enlarged one
    dense = read_dense(tmp_path / about["ply_file_path"], R_up)
    torch.testing.assert_close(dense.points_w, cloud.points_w)
