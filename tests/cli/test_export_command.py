"""`torchslam export` on a run over a few rendered frames: as a user has it."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.box_room import box_cloud, box_depths
from tests.cli.conftest import ROOM
from torchslam.cli.main import main
from torchslam.data import read_trajectory
from torchslam.dense import DepthMaps
from torchslam.geometry import Camera, squared_reprojection_errors, transform
from torchslam.io.export.ply import read_cloud, upright_from_map, write_cloud
from torchslam.io.export.scene import pinhole_within
from torchslam.map.file import read_atlas, read_map, write_atlas


def export(finished: Path, to: str, output: Path | None, *more: str) -> int:
    where = [] if output is None else ["--output", str(output)]
    return main(["export", str(finished), "--to", to, *where, *more])


def own_error(finished: Path) -> float:
    """Mean over the points of their mean error in the keyframes, from the map alone."""
    slam_map, camera = read_map(finished / "map.safetensors")
    seen = slam_map.observations()
    points_c = transform(slam_map.T_cw[seen.keyframe_index], slam_map.positions_w[seen.point_index][:, None])
    errors = squared_reprojection_errors(points_c[:, 0], seen.pixels, camera).sqrt()
    points, which = seen.point_index.unique(return_inverse=True)
    total = torch.zeros(len(points), dtype=errors.dtype).index_add(0, which, errors)
    return float((total / which.bincount()).mean())


def test_colmap_finds_the_error_of_the_map(finished: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    assert export(finished, "colmap", tmp_path / "model") == 0
    made = pycolmap.Reconstruction(str(tmp_path / "model" / "sparse" / "0"))
    made.update_point_3d_errors()
    assert made.compute_mean_reprojection_error() == pytest.approx(own_error(finished), abs=1e-3)
    names = sorted(image.name for image in made.images.values())
    assert names == sorted(path.name for path in (tmp_path / "model" / "images").iterdir())
    slam_map, _ = read_map(finished / "map.safetensors")
    assert made.num_images() == slam_map.num_keyframes
    assert made.num_points3D() == slam_map.num_points


def test_a_rerun_recording_has_every_frame(finished: Path, tmp_path: Path) -> None:
    chunks = pytest.importorskip(
        "rerun.chunk", reason="rerun is not installed: pip install 'torchslam[rerun]'"
    )
    assert export(finished, "rerun", tmp_path / "it.rrd") == 0
    poses = sum(
        chunk.num_rows
        for chunk in chunks.RrdReader(tmp_path / "it.rrd").store().stream()
        if chunk.entity_path == "/world/camera" and not chunk.is_static
    )
    assert poses == len(read_trajectory(finished / "trajectory.txt"))


def test_exports_default_to_the_results_folder(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for to, name in {
        "colmap": "colmap/sparse/0/points3D.bin",
        "nerfstudio": "nerfstudio/transforms.json",
        "ply": "map.ply",
        "tum": "trajectory.txt",
        "kitti": "kitti/poses.txt",
    }.items():
        assert export(copy, to, None) == 0
        assert (copy / "export" / name).is_file()
        assert str(copy / "export") in capsys.readouterr().out
        assert export(copy, to, None) == 2
        assert "--overwrite replaces it" in capsys.readouterr().err
        assert export(copy, to, None, "--overwrite") == 0
    assert (copy / "export" / "map.ply").read_bytes() == (copy / "map.ply").read_bytes()
    written, own = (read_trajectory(folder / "trajectory.txt") for folder in (copy / "export", copy))
    assert torch.equal(written.timestamps, own.timestamps)
    torch.testing.assert_close(written.T_wc, own.T_wc, rtol=0, atol=3e-9)  # nine decimals, twice


def test_the_same_results_give_the_same_bytes(finished: Path, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        assert export(finished, "colmap", tmp_path / folder) == 0
        assert export(finished, "nerfstudio", tmp_path / folder / "nerfstudio") == 0
    files = [path for path in (tmp_path / "one").rglob("*") if path.is_file()]
    assert len(files) > 9
    for path in files:
        assert path.read_bytes() == (tmp_path / "two" / path.relative_to(tmp_path / "one")).read_bytes(), path


def test_frames_can_be_chosen(finished: Path, tmp_path: Path) -> None:
    posed, keyframes = (
        len(read_trajectory(finished / f"{name}.txt")) for name in ("trajectory", "keyframes")
    )
    assert posed > keyframes
    for frames, count in (("all", posed), ("keyframes", keyframes)):
        assert export(finished, "tum", tmp_path / frames, "--frames", frames) == 0
        assert len(read_trajectory(tmp_path / frames)) == count
        folder = tmp_path / f"nerf_{frames}"
        assert export(finished, "nerfstudio", folder, "--frames", frames, "--no-images") == 0
        assert len(json.loads((folder / "transforms.json").read_text())["frames"]) == count
        assert not (folder / "images").exists()


# --- depth maps and the dense cloud ---------------------------------------------------------------------------


@pytest.fixture
def dense(copy: Path) -> Path:
    """Results with depth of half the size for all keyframes but the last one: of a room around the cameras."""
    slam_map, camera = read_map(copy / "map.safetensors")
    frames, order = slam_map.keyframes["frame_index"].sort()
    pinhole = pinhole_within(camera)
    (width, height), (fx, fy, cx, cy) = pinhole.size, pinhole.params.tolist()
    half = Camera.pinhole(
        fx / 2, fy / 2, (cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5, size=(width // 2, height // 2)
    )
    maps = box_depths(slam_map.T_cw[order][:-1], frames[:-1], half)
    (copy / "dense").mkdir()
    maps.save(copy / "dense" / "depths.safetensors")
    write_cloud(copy / "dense.ply", box_cloud(maps), upright_from_map(slam_map))
    return copy


def test_colmap_gets_the_workspace_and_the_start_of_a_splat(dense: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    folder, maps = tmp_path / "model", DepthMaps.load(dense / "dense" / "depths.safetensors")
    assert export(dense, "colmap", folder, "--undistort") == 0
    made = pycolmap.Reconstruction(str(folder / "dense" / "sparse"))
    assert made.num_images() == len(maps)
    made.update_point_3d_errors()
    assert made.compute_mean_reprojection_error() < 1.0
    for image in made.images.values():
        depth = pycolmap.DepthMap()
        depth.read(str(folder / "dense" / "stereo" / "depth_maps" / f"{image.name}.geometric.bin"))
        picture = cv2.imread(str(folder / "dense" / "images" / image.name))
        assert picture.shape[:2] == (made.cameras[1].height, made.cameras[1].width) == depth.to_array().shape
        large = cv2.imread(str(folder / "images" / image.name))
        height, width = picture.shape[:2]
        expected = cv2.resize(large[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        assert np.abs(picture.astype(int) - expected).mean() < 0.1
    cloud = read_cloud(dense / "dense.ply", upright_from_map(read_map(dense / "map.safetensors")[0]))
    for name in ("sparse/0/points3D.ply", "dense/fused.ply"):
        torch.testing.assert_close(
            read_cloud(folder / name).points_w.mean(0), cloud.points_w.mean(0), atol=0.02, rtol=0
        )
    (dense / "dense.ply").unlink()
    assert export(dense, "colmap", folder, "--overwrite") == 0
    assert not (folder / "sparse" / "0" / "points3D.ply").exists()


def test_nerfstudio_gets_depth_for_all_frames_or_none(dense: Path, tmp_path: Path) -> None:
    assert export(dense, "nerfstudio", tmp_path / "keyframes") == 0
    about = json.loads((tmp_path / "keyframes" / "transforms.json").read_text())
    assert len(about["frames"]) == len(DepthMaps.load(dense / "dense" / "depths.safetensors"))
    for frame in about["frames"]:
        assert (tmp_path / "keyframes" / frame["depth_file_path"]).is_file()
        image = cv2.imread(str(tmp_path / "keyframes" / frame["file_path"]))
        assert image.shape[:2] == (about["h"], about["w"])
    assert about["ply_file_path"] == "dense_pc.ply"
    assert export(dense, "nerfstudio", tmp_path / "all", "--frames", "all", "--no-images") == 0
    about = json.loads((tmp_path / "all" / "transforms.json").read_text())
    assert not any("depth_file_path" in frame for frame in about["frames"])
    assert about["ply_file_path"] == "dense_pc.ply"


def test_a_mesh_needs_depth_maps_and_open3d(
    dense: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("torchslam.cli.export.import_open3d", lambda: None)
    (dense / "dense" / "depths.safetensors").unlink()
    assert export(dense, "mesh", tmp_path / "mesh.ply") == 2
    assert "no depth maps: `torchslam densify` writes them" in capsys.readouterr().err
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert export(dense, "mesh", tmp_path / "mesh.ply") == 2
    assert "pip install 'torchslam[mesh]'" in capsys.readouterr().err


def test_a_mesh_has_the_colors_of_the_images(dense: Path, tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d", reason="Open3D is not installed: pip install 'torchslam[mesh]'")
    assert export(dense, "mesh", tmp_path / "mesh.ply") == 0
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    assert len(mesh.triangles) > 10_000
    assert np.asarray(mesh.vertex_colors).std() > 0.1


# --- what goes wrong -----------------------------------------------------------------------------------------


def change(folder: Path, **figures: object) -> None:
    path = folder / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | figures))


def test_missing_images_are_reported(copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(copy, source=str(tmp_path / "moved.mp4"))
    assert export(copy, "colmap", tmp_path / "a") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "moved.mp4: does not exist; use --sequence for its new location" in error
    assert not (tmp_path / "a").exists()
    assert export(copy, "colmap", tmp_path / "a", "--sequence", ROOM) == 0
    assert export(copy, "colmap", tmp_path / "b", "--no-images") == 0
    change(copy, source=None)
    assert export(copy, "nerfstudio", tmp_path / "c") == 2
    assert "the location of the images is unknown" in capsys.readouterr().err


def test_other_submaps_can_be_exported(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = read_atlas(copy / "map.safetensors")
    (submap,) = saved.atlas
    submap.number = 2
    write_atlas(copy / "map.safetensors", [submap], saved.camera)
    assert export(copy, "ply", tmp_path / "a.ply") == 2
    assert "no submap 0: there are 2" in capsys.readouterr().err
    assert export(copy, "ply", tmp_path / "a.ply", "--submap", "2") == 0
    shutil.copy(copy / "trajectory.txt", copy / "trajectory_2.txt")
    (copy / "trajectory.txt").unlink()
    assert export(copy, "tum", tmp_path / "a.txt", "--submap", "2") == 0
    write_atlas(copy / "map.safetensors", [], saved.camera)
    change(copy, submap=None, failure="the camera stood still")
    assert export(copy, "colmap", tmp_path / "b") == 2
    assert "contains no map: the camera stood still" in capsys.readouterr().err


def test_a_localization_run_has_its_trajectory(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(copy, session=1)
    assert export(copy, "kitti", tmp_path / "kitti") == 0
    assert export(copy, "colmap", tmp_path / "a") == 2
    assert "only localized" in capsys.readouterr().err


@pytest.mark.parametrize("to", ["ply", "tum", "kitti"])
def test_formats_without_images_cannot_be_undistorted(
    finished: Path, to: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(finished, to, tmp_path / "a", "--undistort") == 2
    assert "contains no images" in capsys.readouterr().err
