"""The examples run as their docstrings say."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import cv2
import pytest

from examples import live_camera, own_loop, refine_and_export, train_weights
from torchslam.cli.main import main as run
from torchslam.data import read_trajectory
from torchslam.map.file import read_map

CAMERA = "250,250,159.5,119.5"


def images(folder: Path, count: int) -> None:
    """The first frames of the video as images/."""
    (folder / "images").mkdir()
    capture = cv2.VideoCapture(str(folder / "video.mp4"))
    for number in range(count):
        assert cv2.imwrite(str(folder / "images" / f"{number:03d}.png"), capture.read()[1])


def called(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["example", *arguments])


def test_the_own_loop_example_runs(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    images(folder, 20)
    (folder / "images" / "005.png").write_bytes(b"no image")
    called(monkeypatch, "images/*.png", CAMERA, "--output", "out")
    own_loop.main()
    assert "images/019.png: tracking" in capsys.readouterr().out
    assert len(read_trajectory("out/trajectory.txt")) == 19
    assert read_map("out/map.safetensors")[0].num_points > 100


def test_the_live_camera_example_runs(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    called(monkeypatch, "0", CAMERA, "--save", "live.safetensors")
    live_camera.main()
    assert " poses, " in capsys.readouterr().out
    assert Path("live.safetensors").exists()


@pytest.mark.slow
def test_training_without_truth_from_videos_to_a_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("tensorboard")
    given = ["video.mp4", "--held-back", "video.mp4", "--camera", CAMERA, "--without-truth", "--clips", "4"]
    written = ["--tensorboard", "logs", "--output", "weights.safetensors"]
    train_weights.main([*given, "--steps", "2", *written])
    before, after = re.findall(r"held_back_loss ([\d.]+)", capsys.readouterr().out)
    assert before != after
    assert next(Path("logs").iterdir()).stat().st_size > 0
    trained = ["--features", "examples.train_weights:Weighed", "--weights", "weights.safetensors"]
    assert run(["run", "video.mp4", "--camera", CAMERA, "--limit", "25", *trained, "--output", "out"]) == 0
    assert len(read_trajectory("out/trajectory.txt")) == 25


@pytest.mark.slow
def test_refine_and_export(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images(folder, 14)
    called(monkeypatch, "images/*.png", CAMERA)
    own_loop.main()
    called(monkeypatch, "images", "trajectory.txt", CAMERA, "--output", "refined")
    refine_and_export.main()
    assert len(read_trajectory("refined/trajectory.txt")) == 14
    assert {path.name for path in Path("refined/sparse/0").iterdir()} >= {
        "cameras.txt",
        "images.txt",
        "points3D.bin",
    }
