"""Plain image folders and video files, and what is neither."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchslam.data import Calibrated, open_sequence
from torchslam.data.calibration import write_calibration
from torchslam.data.readers.video import VideoSequence
from torchslam.errors import CalibrationError, FrameError, SequenceError
from torchslam.geometry import Camera

CAMERA = "60,60,32,24"


def test_folder_in_natural_order(tmp_path: Path, write_picture: Callable) -> None:
    for index in (10, 9, 1, 100):
        write_picture(tmp_path / f"img_{index}.png", index)
    (tmp_path / "notes.txt").write_text("not an image")
    sequence = open_sequence(tmp_path, CAMERA, fps=10)
    names = [Path(sequence.image_name(index)).name for index in range(4)]
    assert names == ["img_1.png", "img_9.png", "img_10.png", "img_100.png"]
    assert sequence.timestamps.tolist() == [0.0, 0.1, 0.2, 0.3]
    assert sequence.groundtruth is None


def test_folder_needs_a_camera(tmp_path: Path, write_picture: Callable) -> None:
    write_picture(tmp_path / "0.png")
    uncalibrated = open_sequence(tmp_path)
    assert (uncalibrated.calibrated, uncalibrated.size) == (Calibrated.MISSING, (64, 48))
    with pytest.raises(CalibrationError, match="--camera fx,fy,cx,cy"):
        _ = uncalibrated.camera
    (tmp_path / "calibration.txt").write_text("60 60 32 24")
    assert float(open_sequence(tmp_path).camera.fx) == 60.0
    assert float(open_sequence(tmp_path, CAMERA.replace("60", "61")).camera.fx) == 61.0
    (tmp_path / "mine.txt").write_text("62 62 32 24")
    assert float(open_sequence(tmp_path, tmp_path / "mine.txt").camera.fx) == 62.0
    assert float(open_sequence(tmp_path, str(tmp_path / "mine.txt")).camera.fx) == 62.0


def test_the_stated_error_of_a_calibration_counts_wherever_it_lies(
    tmp_path: Path, write_picture: Callable
) -> None:
    write_picture(tmp_path / "0.png")
    camera = Camera.pinhole(60.0, 60.0, 32.0, 24.0, size=(64, 48))
    write_calibration(tmp_path / "calibration.txt", camera, [], std=0.04)
    found, given = open_sequence(tmp_path), open_sequence(tmp_path, tmp_path / "calibration.txt")
    assert (found.camera_std, given.camera_std) == (0.04, 0.04)
    assert found.with_guess() is found
    assert open_sequence(tmp_path, "60,60,32,24").camera_std is None


def test_an_unknown_camera_gets_an_initial_guess(tmp_path: Path, write_picture: Callable) -> None:
    for index in range(3):
        write_picture(tmp_path / f"{index}.png")
    (tmp_path / "calibration.txt").write_text("60 60 32 24")
    guessed = open_sequence(tmp_path, "auto", limit=2)
    width, height = guessed.size
    assert guessed.calibrated is Calibrated.GUESSED
    assert guessed.camera.params.tolist() == [0.85 * width, 0.85 * width, (width - 1) / 2, (height - 1) / 2]
    known = guessed.with_camera(open_sequence(tmp_path).camera)
    assert known.calibrated is Calibrated.GIVEN
    assert float(known.camera.fx) == 60.0
    assert float(guessed.camera.fx) != 60.0
    assert len(known) == 2
    room = open_sequence("synthetic:room", "auto", limit=2)
    assert room.calibrated is Calibrated.GUESSED
    assert float(room.camera.fx) == 0.85 * room.size[0]


def test_bad_image_of_a_folder_is_named(tmp_path: Path, write_picture: Callable) -> None:
    write_picture(tmp_path / "0.png")
    (tmp_path / "1.png").write_bytes((tmp_path / "0.png").read_bytes()[:-20])
    with pytest.raises(FrameError, match=r"1\.png is truncated"):
        open_sequence(tmp_path, CAMERA)[1]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Eight frames at 25 Hz, each of its own brightness."""
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    assert writer.isOpened()
    for index in range(8):
        writer.write(np.full((48, 64, 3), 30 * index, np.uint8))
    writer.release()
    return path


def test_video_in_order_and_back(video: Path) -> None:
    sequence = open_sequence(video, CAMERA)
    assert (len(sequence), sequence.size, sequence.name) == (8, (64, 48), "clip")
    assert sequence.frame_rate == pytest.approx(25.0)
    for index in (0, 1, 4, 7, 2, 2, 0):
        frame = sequence[index]
        assert frame.name.endswith(f"clip.avi#{index}")
        assert float(frame.image.mean()) == pytest.approx(30 * index / 255, abs=0.01)
    assert torch.equal(open_sequence(video, CAMERA, stride=3)[1].image, sequence[3].image)
    assert open_sequence(video, CAMERA, fps=12.5).frame_rate == pytest.approx(12.5)


def test_the_color_of_the_last_frame_of_a_video_is_at_hand(
    video: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = open_sequence(video, "fov=60")
    expected = sequence.color(3)
    monkeypatch.setattr(VideoSequence, "_rewind", lambda _: pytest.fail("the decoder goes back"))
    sequence.image(5)
    assert not torch.equal(sequence.color(5), expected)


def test_unreadable_video(tmp_path: Path) -> None:
    for name, content in (("fake.mp4", b"this is not a video" * 100), ("empty.avi", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SequenceError, match=rf"{name}: cannot be read as a video"):
            open_sequence(tmp_path / name, CAMERA)


def test_damaged_end_of_a_video(tmp_path: Path, video: Path) -> None:
    data = bytearray(video.read_bytes())
    start = data.rfind(b"\xff\xd8")
    end = data.rfind(b"\xff\xd9")
    data[start:end] = bytes(end - start)
    damaged = tmp_path / "damaged.avi"
    damaged.write_bytes(data)
    sequence = open_sequence(damaged, CAMERA)
    assert len(sequence) == 7
    assert sequence.notes == ("7 frames can be decoded; the file declares 8",)
    assert float(sequence[6].image.mean()) == pytest.approx(180 / 255, abs=0.01)
