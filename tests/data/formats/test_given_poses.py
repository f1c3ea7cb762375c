"""Poses of other programs: what our own writers wrote is read again, files made by hand, and what may be wrong."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from tests.io.export.conftest import lens, scene
from torchslam.data import open_sequence
from torchslam.data.formats.given_poses import GivenPoses, read_poses
from torchslam.data.sequence import Sequence
from torchslam.data.trajectories import write_trajectory
from torchslam.errors import CalibrationError, TorchslamError, TrajectoryError
from torchslam.geometry import Camera, se3_exp
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.nerfstudio import write_nerfstudio
from torchslam.io.export.scene import ExportedScene
from torchslam.types import Trajectory

__all__ = ["lens", "scene"]


class Named(Sequence):
    """Images of given names, a tenth of a second apart."""

    def __init__(self, *names: str) -> None:
        times = torch.arange(len(names), dtype=torch.float64) / 10
        super().__init__("named", "names", Camera.pinhole(1, 1, 1, 1, size=(4, 4)), times)
        self.names = names

    def image(self, index: int) -> Tensor:
        return torch.zeros(1, 1, 4, 4)

    def image_name(self, index: int) -> str:
        return self.names[index]


def params_of(given: GivenPoses, camera: Camera) -> list[float]:
    assert given.calibration is not None
    assert given.calibration.camera(camera.size).model == camera.model
    return given.calibration.camera(camera.size).params.tolist()


@pytest.mark.parametrize("name", ["images.bin", "images.txt"])
def test_colmap_poses_round_trip(scene: ExportedScene, tmp_path: Path, name: str) -> None:
    """Binary and text, by folder and by file; of a folder with both the binary."""
    write_colmap(tmp_path, scene)
    (tmp_path / ("images.txt" if name == "images.bin" else "images.bin")).unlink()
    for path in (tmp_path, tmp_path / name):
        given = read_poses(path)
        assert given.names == tuple(scene.image_names)
        torch.testing.assert_close(given.T_cw, scene.T_cw, atol=1e-12, rtol=0)
        assert params_of(given, scene.camera) == pytest.approx(scene.camera.params.tolist())


@pytest.mark.parametrize("lens", ["pinhole", "tangential", "third", "fisheye"], indirect=True)
def test_nerfstudio_poses_round_trip(scene: ExportedScene, tmp_path: Path) -> None:
    """From the file or its folder; the axes of its cameras are turned."""
    write_nerfstudio(tmp_path, scene, torch.eye(3, dtype=torch.float64))
    for path in (tmp_path, tmp_path / "transforms.json"):
        given = read_poses(path)
        assert given.names == tuple(f"images/{name}" for name in scene.image_names)
        torch.testing.assert_close(given.T_cw, scene.T_cw, atol=1e-12, rtol=0)
        assert params_of(given, scene.camera) == pytest.approx(scene.camera.params.tolist())


def test_a_transforms_without_a_camera(tmp_path: Path) -> None:
    """Then the camera must be given; a camera at the origin looks along -z of OpenGL, y up."""
    frames = [{"file_path": "./train/r_0", "transform_matrix": torch.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    given = read_poses(tmp_path)
    assert given.calibration is None
    assert given.T_cw[0].diagonal().tolist() == [1.0, -1.0, -1.0, 1.0]
    assert given.rows(Named("data/train/r_0.png", "data/train/r_1.png")).tolist() == [0, -1]


def test_images_are_matched_by_the_end_of_their_names() -> None:
    """The shortest unique suffix of a path; ambiguous names match nothing."""
    T_cw = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    given = GivenPoses("colmap", Path("model"), T_cw, names=("a/1.png", "b/1.png", "b/2.png"))
    assert given.rows(Named("rgb/b/2.png", "rgb/a/1.png", "rgb/b/1.png", "rgb/c.png")).tolist() == [
        2,
        0,
        1,
        -1,
    ]
    assert given.rows(Named("x/2.png", "x/1.png")).tolist() == [2, -1]
    with pytest.raises(TrajectoryError, match=r"no image has one of its names, such as a/1\.png"):
        given.rows(Named("x/3.png"))


def test_images_are_matched_by_their_times() -> None:
    """Within 20 ms, and no pose is that of two images."""
    T_cw = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    times = torch.tensor([0.015, 0.2, 5.0], dtype=torch.float64)
    given = GivenPoses("tum", Path("poses.txt"), T_cw, times)
    assert given.rows(Named("0", "1", "2", "3")).tolist() == [0, -1, 1, -1]
    late = GivenPoses("tum", Path("poses.txt"), T_cw, times + 100)
    with pytest.raises(
        TrajectoryError, match=r"from 100\.015 to 105\.0 s, are not those of the images, from 0\.0"
    ):
        late.rows(Named("0", "1", "2", "3"))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("transforms.json", "{", "not the frames"),
        ("transforms.json", '{"frames": []}', "transform_matrix of 4 x 4"),
        ("transforms.json", '{"frames": [{"file_path": "a"}]}', "not the frames"),
        (
            "transforms.json",
            json.dumps({"frames": [{"file_path": "a", "transform_matrix": (2 * torch.eye(4)).tolist()}]}),
            "not a rigid transformation",
        ),
        (
            "transforms.json",
            json.dumps({"frames": [{"file_path": "a", "transform_matrix": np.diag([1, 1, -1, 1]).tolist()}]}),
            r"frame a: 1 of 1 poses are mirrored \(determinant -1\)",
        ),
        (
            "transforms.json",  # as ARKit's and Unity's matrices, whose columns are rows elsewhere
            json.dumps(
                {"frames": [{"file_path": "a", "transform_matrix": np.eye(4)[[0, 1, 2, 0]].tolist()}]}
            ),
            "frame a: the last row of transform_matrix is not 0 0 0 1",
        ),
        ("images.txt", "1 1 0 0 0 0 0 0 1\n", "expected `id qw"),
        ("images.txt", "1 3 0 0 0 0 0 0 1 a.png\n\n", "unit length"),
        ("images.txt", "# nothing\n", "no images"),
        ("images.bin", struct.pack("<Q", 2), "not COLMAP's images"),
        ("nothing.txt", "", "neither images.bin"),
    ],
)
def test_invalid_poses_are_refused(tmp_path: Path, name: str, content: str | bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(TrajectoryError, match=message):
        read_poses(tmp_path)


def test_several_cameras_are_too_many(tmp_path: Path) -> None:
    """Those that the images have, and that differ; with a camera of the user's own they do not matter."""
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 1 0 0 2 b.png\n\n")
    for second, message in (
        ("2 PINHOLE 4 4 10 20 2 2", "2 cameras"),
        ("3 PINHOLE 4 4 10 10 2 2", "no camera 2"),
    ):
        (tmp_path / "cameras.txt").write_text(f"1 PINHOLE 4 4 10 10 2 2\n{second}\n")
        with pytest.raises(CalibrationError, match=message):
            read_poses(tmp_path)
        assert read_poses(tmp_path, with_camera=False).calibration is None
    lines = "1 PINHOLE 4 4 10 10 2 2\n2 PINHOLE 4 4 10 10 2 2\n3 PINHOLE 4 4 9 9 2 2\n"
    (tmp_path / "cameras.txt").write_text(lines)
    assert params_of(read_poses(tmp_path), Camera.pinhole(10, 10, 1.5, 1.5, size=(4, 4))) == [
        10,
        10,
        1.5,
        1.5,
    ]


def test_several_cameras_of_a_binary_model(tmp_path: Path) -> None:
    (tmp_path / "images.bin").write_bytes(
        struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 2) + b"a.png\0" + struct.pack("<Q", 0)
    )
    cameras = [struct.pack("<IiQQ4d", number, 1, 4, 4, 10 * number, 10, 2, 2) for number in (1, 2)]
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 2) + b"".join(cameras))
    assert params_of(read_poses(tmp_path), Camera.pinhole(20, 10, 1.5, 1.5, size=(4, 4))) == [
        20,
        10,
        1.5,
        1.5,
    ]
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 1) + cameras[0])
    with pytest.raises(CalibrationError, match="no camera 2"):
        read_poses(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(b"")
    with pytest.raises(TorchslamError, match="not COLMAP's cameras"):
        read_poses(tmp_path)


@pytest.mark.parametrize("points", ["", "10 20 -1 30.5 40 7", None])
def test_colmap_text_with_and_without_lines_of_points(tmp_path: Path, points: str | None) -> None:
    """Who writes it by hand, or strips empty lines, leaves no line for the points of an image."""
    names = ["a 0.jpg", "a 1", "2", "3 b c.jpg"]
    lines = [f"{index + 1} 1 0 0 0 {index} 0 0 1 {name}" for index, name in enumerate(names)]
    text = "\n".join(lines if points is None else [part for line in lines for part in (line, points)])
    (tmp_path / "images.txt").write_text("# by hand\n" + text + "\n")
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 64 48 60 32 24\n")
    given = read_poses(tmp_path)
    assert given.names == tuple(names[index] for index in given.T_cw[:, 0, 3].int().tolist())
    assert sorted(given.T_cw[:, 0, 3].tolist()) == [0.0, 1.0, 2.0, 3.0]


def test_times_that_were_counted_must_all_be_there(tmp_path: Path) -> None:
    """After an image was deleted, the others would have the poses of their neighbors."""
    for index in range(5):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.full((48, 64), 40 * index, np.uint8))
    times, T_wc = (
        torch.arange(1, 5, dtype=torch.float64) / 30,
        torch.eye(4, dtype=torch.float64).repeat(4, 1, 1),
    )
    write_trajectory(tmp_path / "trajectory.txt", Trajectory(times, T_wc))
    given = read_poses(tmp_path / "trajectory.txt")
    assert given.rows(open_sequence(tmp_path)).tolist() == [-1, 0, 1, 2, 3]
    assert given.rows(open_sequence(tmp_path, limit=3)).tolist() == [-1, 0, 1]
    (tmp_path / "2.png").unlink()
    with pytest.raises(TrajectoryError, match=r"1 of 4 poses are of no image of .* are counted: .* rgb\.txt"):
        given.rows(open_sequence(tmp_path))


def test_given_poses_of_a_program_are_checked_as_those_of_files() -> None:
    mirrored = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))[None]
    for T_cw, message in ((mirrored, "mirrored"), (torch.nan * mirrored, "rigid"), (2 * mirrored, "rigid")):
        with pytest.raises(TrajectoryError, match=message):
            GivenPoses("tum", Path("poses.txt"), T_cw, torch.zeros(1, dtype=torch.float64))


def test_rotations_with_few_digits_become_rotations(tmp_path: Path) -> None:
    T_wc = se3_exp(torch.tensor([[1.0, 2.0, 3.0, 0.3, -0.2, 0.5]], dtype=torch.float64))
    frame = {"file_path": "a", "transform_matrix": T_wc[0].mul(1000).round().div(1000).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    R = read_poses(tmp_path).T_cw[0, :3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
