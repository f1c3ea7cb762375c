"""Calibrations: from text and files, right and wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchslam.data import parse_camera, read_calibration
from torchslam.data.calibration import write_calibration
from torchslam.errors import CalibrationError
from torchslam.geometry import Camera


@pytest.mark.parametrize(
    ("text", "model", "params"),
    [
        ("500,501,320,240", "pinhole", [500, 501, 320, 240]),
        ("500 501 320 240 0 0 0 0 0", "pinhole", [500, 501, 320, 240]),
        (
            "500,501,320,240,.1,-.2,.01,.02",
            "radial_tangential",
            [500, 501, 320, 240, 0.1, -0.2, 0.01, 0.02, 0],
        ),
        (
            "500,501,320,240,.1,-.2,.01,.02,3",
            "radial_tangential",
            [500, 501, 320, 240, 0.1, -0.2, 0.01, 0.02, 3],
        ),
        ("fisheye,500,501,320,240,1,2,3,4", "fisheye", [500, 501, 320, 240, 1, 2, 3, 4]),
    ],
)
def test_parse_camera(text: str, model: str, params: list[float]) -> None:
    camera = parse_camera(text, (640, 480))
    assert (camera.model, camera.size) == (model, (640, 480))
    assert camera.params.tolist() == params


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "got nothing"),
        ("500,500,320", "got 3 numbers"),
        ("500,500,320,240,0.1", "got 5 numbers"),
        ("pinhole,500,500,320,240,1,2,3,4", "got 8 numbers"),
        ("fisheye,500,500,320,240", "got 4 numbers"),
        ("nan,500,320,240", "`nan` is not a finite number"),
        ("500,500,320,inf", "`inf` is not a finite number"),
        ("500,500,320,abc", "`abc` is not a number"),
        ("-500,500,320,240", "focal lengths must be positive, got -500 and 500"),
        ("500,0,320,240", "focal lengths must be positive"),
    ],
)
def test_bad_numbers(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=f"--camera: .*{message}"):
        parse_camera(text, (640, 480))
    file = tmp_path / "calibration.txt"
    file.write_text(f"# fx fy cx cy\n{text}\n")
    where = r"calibration\.txt:2: .*" + message if text else r"calibration\.txt: no numbers"
    with pytest.raises(CalibrationError, match=where):
        read_calibration(file)


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        ("txt", "1 PINHOLE 64 0 500 500 32 24\n"),
        ("json", '{"w": 0, "h": 48, "fl_x": 500, "fl_y": 500, "cx": 32, "cy": 24, "frames": []}'),
        (
            "yaml",
            "image_width: -64\nimage_height: 48\ncamera_matrix: {data: [500, 0, 32, 0, 500, 24, 0, 0, 1]}\n",
        ),
    ],
)
def test_a_stated_size_must_be_positive(tmp_path: Path, suffix: str, text: str) -> None:
    file = tmp_path / f"calibration.{suffix}"
    file.write_text(text)
    with pytest.raises(CalibrationError, match="the size of the images must be positive"):
        read_calibration(file)


def test_distortion_in_a_file_next_to_the_calibration(tmp_path: Path) -> None:
    (tmp_path / "calibration.txt").write_text("500 501 320 240\n")
    (tmp_path / "distortion.txt").write_text("# k1 k2 p1 p2 k3\n-0.28 0.07 0.0002 1.7e-05 0.0\n")
    calibration = read_calibration(tmp_path / "calibration.txt")
    assert calibration.model == "radial_tangential"
    assert calibration.params == (500, 501, 320, 240, -0.28, 0.07, 0.0002, 1.7e-05, 0)


@pytest.mark.parametrize(("text", "message"), [("1 2 3", "got 3 numbers"), ("1 2 3 nan", "finite number")])
def test_bad_distortion_names_its_own_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "calibration.txt").write_text("500 501 320 240\n")
    (tmp_path / "distortion.txt").write_text(text)
    with pytest.raises(CalibrationError, match=rf"distortion\.txt:1: .*{message}"):
        read_calibration(tmp_path / "calibration.txt")


@pytest.mark.parametrize(
    ("numbers", "size", "fitting"),
    [
        ("1000,1000,639.5,479.5", (640, 480), "1280 x 960"),
        ("250,250,159.5,119.5", (640, 480), "320 x 240"),
        ("500,500,319.5,239.5", (640, 360), "640 x 480"),
        ("500,500,319.5,239.5", (480, 640), "640 x 480"),
        ("600,600,383.5,287.5,0.1,0,0,0", (640, 480), "768 x 576"),
        ("fisheye,500,500,0,0,0,0,0,0", (640, 480), "1 x 1"),
    ],
)
def test_a_calibration_of_another_size_that_states_none(
    numbers: str, size: tuple[int, int], fitting: str
) -> None:
    message = (
        f"--camera: the principal point .* is far from the middle of images of {size[0]}x{size[1]}: "
        f"it would fit about {fitting} pixels; give the calibration of this size"
    )
    with pytest.raises(CalibrationError, match=message):
        parse_camera(numbers, size)


def test_principal_points_of_real_cameras_are_accepted(tmp_path: Path) -> None:
    for numbers, size in (
        ("517,516,318.6,255.3", (640, 480)),
        ("552.55,552.55,682.05,238.77", (1408, 376)),  # KITTI-360, rectified
        ("1266,1266,816.3,491.5", (1600, 900)),  # nuScenes
    ):
        assert parse_camera(numbers, size).size == size
    cropped = tmp_path / "cropped.yaml"
    cropped.write_text("fx: 500\nfy: 500\ncx: 100\ncy: 50\nimage_width: 640\nimage_height: 480\n")
    assert parse_camera(str(cropped), (640, 480)).params.tolist() == [500, 500, 100, 50]


def test_a_written_calibration_states_its_size(tmp_path: Path) -> None:
    path = tmp_path / "calibration.txt"
    camera = Camera.pinhole(500.0, 500.0, 100.0, 50.0, size=(640, 480))
    write_calibration(path, camera, ["by hand"], std=0.01)
    found = read_calibration(path)
    assert (found.size, found.std) == ((640, 480), 0.01)
    assert found.camera((640, 480)).params.tolist() == camera.params.tolist()
    with pytest.raises(
        CalibrationError, match=r"calibration\.txt:6: .* images of 640x480, these are 320x240"
    ):
        found.camera((320, 240))


def test_unreadable_files(tmp_path: Path) -> None:
    (tmp_path / "binary.txt").write_bytes(b"\x89PNG\xff\xfe\x00")
    for name in ("nothing.txt", "binary.txt"):
        with pytest.raises(CalibrationError, match=rf"{name}: cannot be read"):
            read_calibration(tmp_path / name)
