"""Folders as 7-Scenes, TartanAir, ICL-NUIM and KITTI raw ship them, with poses whose axes are known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from torchslam.data import Calibrated, open_sequence
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError
from torchslam.geometry.camera import Camera

VGA = (640, 480)
Write = Callable[..., np.ndarray]


@pytest.fixture
def seven_scenes(tmp_path: Path, write_picture: Write) -> Path:
    folder = tmp_path / "office" / "seq-01"
    for index in range(3):
        name = folder / f"frame-{index:06d}"
        write_picture(Path(f"{name}.color.png"), index, VGA)
        write_picture(Path(f"{name}.depth.png"), 100 + index, VGA)
        pose = np.eye(4)
        pose[0, 3] = index
        np.savetxt(f"{name}.pose.txt", pose)
    return folder


def test_seven_scenes(seven_scenes: Path) -> None:
    sequence = open_sequence(seven_scenes)
    assert (len(sequence), sequence.size, sequence.name) == (3, VGA, "office/seq-01")
    assert all("color" in sequence.image_name(index) for index in range(3))
    assert sequence.timestamps.tolist() == [0, 1 / 30, 2 / 30]
    assert sequence.calibrated is Calibrated.GUESSED
    assert float(sequence.camera.fx) == 525.0
    assert sequence.groundtruth.positions_w[:, 0].tolist() == [0, 1, 2]
    assert open_sequence(seven_scenes, "500,500,320,240").calibrated is Calibrated.GIVEN


def test_seven_scenes_without_some_poses(seven_scenes: Path) -> None:
    (seven_scenes / "frame-000000.pose.txt").write_text("1.#INF nan nan nan\n" * 4)
    (seven_scenes / "frame-000001.pose.txt").write_text("0 0 0 0\n" * 3 + "0 0 0 1\n")
    assert open_sequence(seven_scenes).groundtruth.timestamps.tolist() == [2 / 30]
    (seven_scenes / "frame-000002.pose.txt").write_text("1 2 3\n")
    with pytest.raises(TrajectoryError, match=r"frame-000002\.pose\.txt:1: expected .* got 3 numbers"):
        open_sequence(seven_scenes)


def test_seven_scenes_as_a_whole(seven_scenes: Path) -> None:
    with pytest.raises(
        SequenceError, match=r"office: no sequence, but 1 folder with one; did you mean .*office/seq-01\?"
    ):
        open_sequence(seven_scenes.parent)
    (seven_scenes.parent / "seq-02").mkdir()
    (seven_scenes / "frame-000002.color.png").rename(
        seven_scenes.parent / "seq-02" / "frame-000002.color.png"
    )
    with pytest.raises(SequenceError, match=r"which of .*seq-01 or .*seq-02\?"):
        open_sequence(seven_scenes.parent)


@pytest.mark.parametrize(("name", "size"), [("left", VGA), ("lcam_front", (640, 640))])
def test_tartanair(tmp_path: Path, write_picture: Write, name: str, size: tuple[int, int]) -> None:
    """The camera moves forward, to the right and down by 3, 2 and 1 meters, then turns to the right."""
    for index in range(2):
        write_picture(tmp_path / f"image_{name}" / f"{index:06d}_{name}.png", index, size)
    half = np.sqrt(0.5)  # a quarter turn about down
    (tmp_path / f"pose_{name}.txt").write_text(f"0 0 0 0 0 0 1\n3 2 1 0 0 {half} {half}\n")
    sequence = open_sequence(tmp_path, fps=10)
    assert sequence.timestamps.tolist() == [0.0, 0.1]
    assert sequence.camera.params.tolist() == [320, 320, 320, size[1] / 2]
    T_01 = sequence.pose(0) @ torch.linalg.inv(sequence.pose(1))  # from the second camera to the first
    torch.testing.assert_close(T_01[:3, 3], torch.tensor([2.0, 1.0, 3.0], dtype=torch.float64))
    torch.testing.assert_close(T_01[:3, 2], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(T_01[:3, 1], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    (tmp_path / f"pose_{name}.txt").write_text("0 0 0 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match="1 poses for 2 images"):
        open_sequence(tmp_path)


def test_icl_nuim(tmp_path: Path, write_picture: Write) -> None:
    """A point projected by the published camera, fy negative, is where ours sees its mirror image."""
    for index in (1, 2, 10):
        write_picture(tmp_path / "rgb" / f"{index}.png", index, VGA)
        write_picture(tmp_path / "depth" / f"{index}.png", index, VGA)
    (tmp_path / "associations.txt").write_text("1 depth/1.png 1 rgb/1.png\n")
    poses = [(1, 0.1, 0.2, 0.3, 0, 0, 0, 1), (10, 1, 2, 3, 0.6, 0, 0, 0.8), (11, 0, 0, 0, 0, 0, 0, 1)]
    (tmp_path / "livingRoom0.gt.freiburg").write_text(
        "".join(" ".join(map(str, pose)) + "\n" for pose in poses)
    )
    sequence = open_sequence(tmp_path)
    assert sequence.timestamps.tolist() == [1 / 30, 2 / 30, 10 / 30]
    point_w = torch.tensor([1.5, 1.0, 6.0], dtype=torch.float64)
    R = torch.tensor([[1, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]], dtype=torch.float64)
    x, y, z = R.T @ (point_w - torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    expected = torch.stack((481.2 * x / z + 319.5, -480.0 * y / z + 239.5))
    mirrored = point_w * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    T_cw = sequence.pose(2)
    pixels, valid = sequence.camera.project((T_cw[:3, :3] @ mirrored + T_cw[:3, 3])[None])
    assert bool(valid)
    torch.testing.assert_close(pixels[0], expected)


CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
K_00: 70 0 32 0 71 24 0 0 1
D_00: -0.3 0.2 0.001 0.002 -0.07
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 60 0 31 0 0 61 23 0 0 0 1 0
K_02: 70 0 32 0 71 24 0 0 1
P_rect_02: 60 0 31 -30 0 60 23 0 0 0 1 0
"""


@pytest.fixture
def kitti_raw(tmp_path: Path, write_picture: Write) -> Callable[..., Path]:
    """A drive north by a meter a frame; the second of four frames is missing."""

    def write(kind: str = "sync", camera: str = "00") -> Path:
        day = tmp_path / "2011_09_26"
        drive = day / f"2011_09_26_drive_0001_{kind}"
        for index in (0, 2, 3):
            write_picture(drive / f"image_{camera}" / "data" / f"{index:010d}.png", index)
        times = [f"2011-09-26 13:02:25.{100_000_000 + index * 103_000_001:09d}\n" for index in range(4)]
        (drive / f"image_{camera}" / "timestamps.txt").write_text("".join(times))
        (drive / "oxts" / "data").mkdir(parents=True)
        (drive / "oxts" / "timestamps.txt").write_text("".join(times))
        for index in range(4):
            latitude = 49 + np.degrees(index / 6378137)
            row = [latitude, 8.4, 100, 0, 0, np.pi / 2] + [0] * 24  # yaw: x of the car points north
            (drive / "oxts" / "data" / f"{index:010d}.txt").write_text(" ".join(map(repr, map(float, row))))
        (day / "calib_cam_to_cam.txt").write_text(CAM_TO_CAM)
        # The car: x forward, y left, z up; the camera: x right, y down, z forward.
        (day / "calib_velo_to_cam.txt").write_text("calib_time: x\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0.5\n")
        (day / "calib_imu_to_velo.txt").write_text("calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n")
        return drive

    return write


def test_kitti_raw(kitti_raw: Callable[..., Path]) -> None:
    sequence = open_sequence(kitti_raw())
    seconds = 13 * 3600 + 2 * 60 + 25.1
    assert sequence.timestamps.tolist() == pytest.approx(
        [seconds, seconds + 0.206000002, seconds + 0.309000003], abs=1e-9
    )
    assert sequence.camera.params.tolist() == [60, 61, 31, 23]
    assert sequence.kind == "KITTI raw, image_00"
    T_02 = sequence.pose(0) @ torch.linalg.inv(sequence.pose(1))
    expected = torch.eye(4, dtype=torch.float64)
    expected[2, 3] = 2.0  # two meters forward
    torch.testing.assert_close(T_02, expected, atol=1e-4, rtol=0)
    position = sequence.groundtruth.positions_w[0]  # half a meter behind the GPS, which looks north
    torch.testing.assert_close(position, torch.tensor([0, -0.5, 0], dtype=torch.float64), atol=1e-9, rtol=0)


def test_poses_of_the_right_camera_are_relative_to_the_first(kitti_raw: Callable[..., Path]) -> None:
    """P_rect_02 puts its camera half a meter to the right of camera 0: east, on the way north."""
    sequence = open_sequence(kitti_raw(camera="02"))
    position = sequence.groundtruth.positions_w[0]
    torch.testing.assert_close(position, torch.tensor([0.5, -0.5, 0], dtype=torch.float64), atol=1e-9, rtol=0)


def test_kitti_raw_unsynchronized(kitti_raw: Callable[..., Path]) -> None:
    camera = open_sequence(kitti_raw("extract")).camera
    assert isinstance(camera, Camera)
    assert camera.params.tolist() == [70, 71, 32, 24, -0.3, 0.2, 0.001, 0.002, -0.07]


def test_kitti_raw_with_missing_or_wrong_files(kitti_raw: Callable[..., Path]) -> None:
    drive = kitti_raw()
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    assert open_sequence(drive).groundtruth is None
    (drive.parent / "calib_cam_to_cam.txt").write_text("P_rect_00: 1 2 3\n")
    with pytest.raises(CalibrationError, match="expected a line `P_rect_00:` of 12 numbers"):
        open_sequence(drive)
    (drive.parent / "calib_cam_to_cam.txt").unlink()
    assert open_sequence(drive).calibrated is Calibrated.MISSING
    (drive / "image_00" / "timestamps.txt").write_text("2011-09-26 13:02:25.1\n2011-13-26 13:02:25.1\n")
    with pytest.raises(SequenceError, match=r"timestamps\.txt:2: expected"):
        open_sequence(drive)
    (drive / "image_00" / "timestamps.txt").write_text("2011-09-26 13:02:25.1\n")
    with pytest.raises(SequenceError, match=r"0000000002\.png: timestamps\.txt has no line"):
        open_sequence(drive)


def test_camera_of_a_tum_archive_by_its_name(tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder(calibration=None)
    renamed = folder.rename(folder.with_name("rgbd_dataset_freiburg2_desk"))
    with pytest.raises(
        CalibrationError, match="`tum-fr2`: the camera is for images of 640x480, these are 64x48"
    ):
        open_sequence(renamed)
