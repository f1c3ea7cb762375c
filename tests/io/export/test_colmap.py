"""COLMAP's own reader is the oracle: it finds our poses, points, tracks, and our reprojection error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.io.export.conftest import reprojection_error
from torchslam.geometry import transform
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.scene import ExportedScene

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


@pytest.mark.parametrize("blind", [[1], [0, 1, 2, 3]])
def test_images_without_observations_are_written(
    scene: ExportedScene, tmp_path: Path, reader: str, blind: list[int]
) -> None:
    seen = ~torch.isin(scene.frame_index, torch.tensor(blind))
    points = scene.points_w if seen.any() else scene.points_w[:0]
    rows = {name: getattr(scene, name)[seen] for name in ("frame_index", "point_index", "pixels")}
    write_colmap(tmp_path, replace(scene, points_w=points, colors=scene.colors[: len(points)], **rows))
    made = read(tmp_path, reader)
    assert made.num_images() == 4
    assert made.num_points3D() == len(points)
    assert len(made.image(2).points2D) == 0
