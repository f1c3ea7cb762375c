"""Calibrations: from text and files, right and wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchslam.data import parse_camera, read_calibration
from torchslam.errors import CalibrationError


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


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"nothing\.txt: cannot be read"):
        read_calibration(tmp_path / "nothing.txt")


def test_binary_file(tmp_path: Path) -> None:
    (tmp_path / "calibration.txt").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_calibration(tmp_path / "calibration.txt")
