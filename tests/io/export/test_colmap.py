"""COLMAP's own reader is the oracle: it finds our poses, points, tracks, and our reprojection error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.io.export.conftest import reprojection_error
from torchslam.geometry import transform
from torchslam.io.export.colmap import colmap_camera, write_colmap
from torchslam.io.export.scene import ExportedScene, undistorted

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")


@pytest.fixture(params=["read_binary", "read_text"])
def reader(request: pytest.FixtureRequest) -> str:
    return request.param


def read(folder: Path, reader: str) -> pycolmap.Reconstruction:
    made = pycolmap.Reconstruction()
    getattr(made, reader)(str(folder))
    assert made.is_valid()
    return made


def test_colmap_computes_our_reprojection_error(scene: ExportedScene, tmp_path: Path, reader: str) -> None:
    write_colmap(tmp_path, scene)
    made, ours = read(tmp_path, reader), reprojection_error(scene)
    assert made.compute_mean_reprojection_error() == pytest.approx(ours, abs=1e-9)  # as written
    made.update_point_3d_errors()
    assert made.compute_mean_reprojection_error() == pytest.approx(ours, abs=1e-6)  # by its own projection


def test_a_scene_without_points_is_a_model_without_points(
    scene: ExportedScene, tmp_path: Path, reader: str
) -> None:
    none = torch.zeros(0, dtype=torch.int64)
    write_colmap(
        tmp_path,
        replace(
            scene,
            points_w=scene.points_w[:0],
            colors=scene.colors[:0],
            pixels=scene.pixels[:0],
            frame_index=none,
            point_index=none,
        ),
    )
    made = read(tmp_path, reader)
    assert len(made.images) == 4
    assert len(made.points3D) == 0


def test_points_tracks_and_images_round_trip(scene: ExportedScene, tmp_path: Path, reader: str) -> None:
    write_colmap(tmp_path, scene)
    made = read(tmp_path, reader)
    assert [made.image(number).name for number in (1, 2, 3, 4)] == scene.image_names
    seen = 0
    for number, image in made.images.items():
        matrix = image.cam_from_world().matrix()
        np.testing.assert_allclose(matrix, scene.T_cw[number - 1, :3], atol=1e-12)
        rows = torch.nonzero(scene.frame_index == number - 1)[:, 0]
        for row, point in zip(rows.tolist(), image.points2D, strict=True):
            assert point.point3D_id == int(scene.point_index[row]) + 1
            np.testing.assert_allclose(point.xy, scene.pixels[row] + 0.5, atol=1e-12)
    for number, point in made.points3D.items():
        np.testing.assert_array_equal(point.color, scene.colors[number - 1])
        np.testing.assert_allclose(point.xyz, scene.points_w[number - 1], atol=1e-12)
        for element in point.track.elements:
            seen += 1
            assert made.image(element.image_id).points2D[element.point2D_idx].point3D_id == number
    assert seen == len(scene.pixels)


def test_the_colmap_camera_projects_like_ours(scene: ExportedScene, tmp_path: Path, reader: str) -> None:
    write_colmap(tmp_path, scene)
    made = read(tmp_path, reader)
    points_c = transform(scene.T_cw[0], scene.points_w)
    ours, _ = scene.camera.project(points_c)
    theirs = np.array([made.camera(1).img_from_cam(point) for point in points_c.numpy()])
    np.testing.assert_allclose(theirs, ours + 0.5, atol=1e-9)
    assert (made.camera(1).width, made.camera(1).height) == scene.camera.size


def test_every_camera_model_has_a_colmap_name(scene: ExportedScene) -> None:
    model, params = colmap_camera(scene.camera)
    more = any(scene.camera.params.tolist()[8:])
    expected = {"pinhole": "PINHOLE", "fisheye": "OPENCV_FISHEYE"}.get(scene.camera.model)
    assert model == (expected or ("FULL_OPENCV" if more else "OPENCV"))
    assert len(params) == {"PINHOLE": 4, "OPENCV": 8, "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12}[model]


def test_without_distortion_the_error_is_that_of_the_new_pixels(scene: ExportedScene, tmp_path: Path) -> None:
    flat = undistorted(scene)
    write_colmap(tmp_path, flat)
    made = read(tmp_path, "read_binary")
    made.update_point_3d_errors()
    assert made.camera(1).model_name == "PINHOLE"
    assert made.compute_mean_reprojection_error() == pytest.approx(reprojection_error(flat), abs=1e-6)


def test_an_image_without_observations_is_written(scene: ExportedScene, tmp_path: Path, reader: str) -> None:
    seen = scene.frame_index != 1
    blind = replace(
        scene,
        frame_index=scene.frame_index[seen],
        point_index=scene.point_index[seen],
        pixels=scene.pixels[seen],
    )
    write_colmap(tmp_path, blind)
    made = read(tmp_path, reader)
    assert made.num_images() == 4
    assert len(made.image(2).points2D) == 0
