"""The options of the command line that say what is read, and what is said about it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchslam.cli.main import main
from torchslam.data import open_sequence

FAST = ["--features", "opencv-orb", "--set", "features.num_keypoints=300"]


def info(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, str], str]:
    status = main(["info", *arguments])
    captured = capsys.readouterr()
    rows = [line.strip().partition("   ") for line in captured.out.splitlines()]
    return status, {label: value.strip() for label, _, value in rows}, captured.err


def test_info_of_chosen_frames(tum_folder: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--start", "0.1s", "--stop", "5", "--stride", "2", "--resize", "32x24", "--camera", "fov=90"]
    status, rows, _ = info(capsys, str(tum_folder()), *options)
    assert status == 2  # a side of 24 pixels
    options[7] = "48x36"
    status, rows, _ = info(capsys, str(tum_folder()), *options)
    assert (status, rows["frames"], rows["size"]) == (0, "2", "48x36")
    assert rows["camera"] == "pinhole 24 24 23.5 17.5 (guessed)"
    assert rows["rate"] == "5.00 Hz over 0.20 s"


def test_info_without_a_camera(
    tmp_path: Path, write_picture: Callable[..., np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    for index in range(3):
        write_picture(tmp_path / f"{index}.png", index)
        write_picture(tmp_path / f"._{index}.png", index)
    status, rows, errors = info(capsys, str(tmp_path), "--fps", "10")
    assert (status, rows["camera"]) == (0, "missing; estimated from the images unless --camera is given")
    assert rows["rate"] == "10.00 Hz over 0.20 s"
    assert "ignored: 3 hidden files" in errors
    assert (
        main(["run", str(tmp_path), "-o", str(tmp_path / "results")]) == 3
    )  # the intrinsics cannot be estimated from these images
    assert "no calibration found; estimating intrinsics" in capsys.readouterr().err


@pytest.mark.usefixtures("without_pictures")
def test_run_under_a_mask(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mask = np.full((480, 640), 255, np.uint8)
    mask[:, :200] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    sequence = ["synthetic:room?frames=12", "--stop", "10", "--mask", str(tmp_path / "mask.png")]
    assert main(["run", *sequence, "-o", str(tmp_path / "r"), "--resize", "0.5", *FAST]) in (0, 3)
    figures = json.loads((tmp_path / "r" / "metrics.json").read_text())
    assert (figures["frames"], figures["dropped"]) == (10, 0)
    masked = open_sequence("synthetic:room?frames=12", mask=tmp_path / "mask.png", resize_to="0.5")
    assert masked[0].mask[0, 0, :, :100].any().item() is False
    assert float(masked.camera.fx) == 250.0
