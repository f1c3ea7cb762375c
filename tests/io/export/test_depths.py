"""Depth maps for other programs, of a room whose depth is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.box_room import HALF, box_cloud, box_depths, wall_colors
from torchslam.dense import DepthMaps
from torchslam.errors import ResultsError
from torchslam.geometry import Camera, rigid, so3_exp, transform
from torchslam.io.export.colmap import colmap_map, write_workspace
from torchslam.io.export.nerfstudio import UNIT, depth_png
from torchslam.io.export.ply import read_cloud
from torchslam.io.export.scene import ExportedScene, Undistorter, enlarged, undistorted

SMALL = Camera.pinhole(50.0, 52.0, 31.0, 23.0, size=(64, 48))
FRAMES = 6


@pytest.fixture
def room(tmp_path: Path) -> tuple[ExportedScene, Path]:
    """Points of the far wall before cameras side by side, and the file of their depth maps."""
    x = 0.25 * torch.arange(FRAMES, dtype=torch.float64)
    zero = torch.zeros_like(x)
    T_cw = rigid(
        so3_exp(torch.stack((zero, 0.05 * x, zero), dim=-1)), torch.stack((0.6 - x, zero, zero), dim=-1)
    )
    u, v = torch.meshgrid(*(torch.linspace(-1.0, 1.0, 6).double(),) * 2, indexing="ij")
    points_w = torch.stack((u.flatten(), v.flatten(), torch.full((36,), HALF)), dim=-1)
    pixels, valid = SMALL.to(torch.float64).project(transform(T_cw, points_w.expand(FRAMES, -1, -1)))
    assert valid.all()
    maps = box_depths(T_cw, 5 * torch.arange(FRAMES), SMALL)
    scene = ExportedScene(
        camera=SMALL.to(torch.float64),
        frame_ids=maps.frame_index,
        timestamps=maps.frame_index / 10.0,
        is_keyframe=torch.ones(FRAMES, dtype=torch.bool),
        T_cw=T_cw,
        points_w=points_w,
        colors=wall_colors(points_w),
        frame_index=torch.arange(FRAMES).repeat_interleave(36),
        point_index=torch.arange(36).repeat(FRAMES),
        pixels=pixels.flatten(0, 1),
    )
    maps.save(tmp_path / "depths.safetensors")
    return scene, tmp_path / "depths.safetensors"


class Painted:
    """Images of the walls, as `Images` has them."""

    def __init__(self, maps: DepthMaps) -> None:
        colors = box_cloud(maps).colors.reshape(len(maps), maps.camera.height, maps.camera.width, 3)
        self._by_frame = dict(zip(maps.frame_index.tolist(), colors.numpy(), strict=True))

    def bgr(self, frame_id: int) -> np.ndarray:
        return np.ascontiguousarray(self._by_frame[frame_id][..., ::-1])


def test_a_depth_image_has_thousandths_and_zero_where_depth_is_unknown() -> None:
    depth = torch.tensor([[0.0, 1.0, 2.0004], [65.535, 65.6, 1e6]])
    image = cv2.imdecode(np.frombuffer(depth_png(depth), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    assert image.tolist() == [[0, 1000, 2000], [65535, 0, 0]]
    assert UNIT == 1e-3


def test_normals_are_in_the_order_of_the_format(room: tuple[ExportedScene, Path]) -> None:
    """Column-major order of (width, height, channels). `NormalMap.to_array` of pycolmap takes it for another."""
    normal = DepthMaps.load(room[1]).normal[2]
    width, height, channels, numbers = colmap_map(normal).split(b"&", 3)
    shape = (int(width), int(height), int(channels))
    found = np.frombuffer(numbers, "<f4").reshape(shape, order="F")
    np.testing.assert_array_equal(found.transpose(2, 1, 0), normal)


def test_colmap_fuses_the_workspace_and_makes_a_mesh_of_it(
    room: tuple[ExportedScene, Path], tmp_path: Path
) -> None:
    """COLMAP's own programs find the walls, in their colors, with normals into the room."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    scene, path = room
    maps, folder = DepthMaps.load(path), tmp_path / "dense"
    write_workspace(folder, scene, path, box_cloud(maps), Painted(maps))  # type: ignore[arg-type]
    options = pycolmap.StereoFusionOptions()
    options.num_threads = 1
    options.min_num_pixels = 3
    made = pycolmap.stereo_fusion(folder / "again.ply", folder, options=options, output_type="PLY")
    points = np.array([point.xyz for point in made.points3D.values()])
    colors = np.array([point.color for point in made.points3D.values()])
    assert len(points) > 1000
    # It takes the corner of a pixel for its center, so that depth is off where the camera is oblique.
    np.testing.assert_allclose(np.abs(points).max(axis=1), HALF, atol=3e-3)
    vertices = (folder / "again.ply").read_bytes().split(b"end_header\n")[1]
    normals = np.frombuffer(
        vertices, np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
    )["normal"]
    inward = -(normals * points).sum(axis=1) / np.linalg.norm(points, axis=1)
    assert (inward > 0.5).all()
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0, atol=1e-3)
    assert np.median(np.abs(colors.astype(int) - wall_colors(torch.from_numpy(points)).numpy())) <= 4
    again = read_cloud(folder / "fused.ply")
    torch.testing.assert_close(again.points_w, box_cloud(maps).points_w)
    for name in ("again.ply", "fused.ply"):
        meshing = pycolmap.PoissonMeshingOptions()
        meshing.depth, meshing.trim, meshing.num_threads = 6, 3.0, 1
        pycolmap.poisson_meshing(folder / name, folder / "mesh.ply", meshing)
        assert (folder / "mesh.ply").stat().st_size > 10_000


def test_a_workspace_has_a_line_for_each_image(room: tuple[ExportedScene, Path], tmp_path: Path) -> None:
    scene, path = room
    old = tmp_path / "stereo" / "depth_maps" / "000007.png.geometric.bin"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"")
    write_workspace(tmp_path, scene, path, None, None)
    names = [f"{5 * frame:06d}.png" for frame in range(FRAMES)]
    assert (tmp_path / "stereo" / "fusion.cfg").read_text().split() == names
    lines = (tmp_path / "stereo" / "patch-match.cfg").read_text().splitlines()
    assert lines[0::2] == names
    assert set(lines[1::2]) == {"__auto__, 20"}
    for kind in ("depth_maps", "normal_maps"):
        files = sorted(file.name for file in (tmp_path / "stereo" / kind).iterdir())
        assert files == [f"{name}.geometric.bin" for name in names], "those of an earlier export are deleted"
    assert not (tmp_path / "images").exists()
    assert not (tmp_path / "fused.ply").exists()


@pytest.mark.parametrize("factor", [1, 2, 2.5])
def test_an_enlarged_camera_sees_the_same(factor: float) -> None:
    camera = Camera.pinhole(50.0 * factor, 52.0 * factor, 1.0, 1.0, size=(10, 10))
    large = enlarged(SMALL, camera)
    assert large.size == (64 * factor, 48 * factor)
    for pixel in ((-0.5, -0.5), (63.5, 47.5), (10.0, 20.0)):
        small = torch.tensor([pixel], dtype=torch.float64)
        torch.testing.assert_close(large.normalize((small + 0.5) * factor - 0.5), SMALL.normalize(small))


def test_a_smaller_undistorted_image_is_the_mean_of_its_pixels() -> None:
    """Without means over pixels, the noise would stay as strong as it is."""
    camera = Camera.pinhole(200.0, 208.0, 4 * 31.5 - 0.5, 4 * 23.5 - 0.5, size=(256, 192))
    image = np.random.default_rng(0).integers(0, 256, (192, 256), dtype=np.uint8)
    small = Undistorter(camera, SMALL)(image)
    expected = cv2.resize(image, SMALL.size, interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - expected).max() <= 1


def test_the_scene_of_some_frames_keeps_points_that_two_of_them_see(scene: ExportedScene) -> None:
    part = scene.of_frames(torch.tensor((3, 90)))
    assert part.frame_ids.tolist() == [3, 90]
    assert part.is_keyframe.tolist() == [True, True]
    assert len(part.points_w) == 29  # frame 3 does not see the first point
    torch.testing.assert_close(part.points_w, scene.points_w[1:])
    assert torch.bincount(part.point_index).tolist() == [2] * 29
    whole = scene.frame_index[:, None] == torch.tensor((0, 3))
    rows = torch.nonzero(whole.any(dim=1) & (scene.point_index > 0))[:, 0]
    assert torch.equal(part.pixels, scene.pixels[rows])
    with pytest.raises(ResultsError, match="frame 4 has no pose"):
        scene.of_frames(torch.tensor((3, 4)))


def test_a_scene_is_undistorted_to_the_camera_of_the_depth(scene: ExportedScene) -> None:
    flat = undistorted(scene, SMALL.to(torch.float64))
    assert flat.camera.size == SMALL.size
    points_c = transform(scene.T_cw[scene.frame_index], scene.points_w[scene.point_index][:, None])
    error = flat.camera.project(points_c)[0][:, 0] - flat.pixels
    assert float(error.norm(dim=-1).median()) < 0.5  # half a pixel of noise in images four times as large
