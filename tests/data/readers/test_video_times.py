"""Videos whose frames do not come at a constant rate, or are to be shown turned."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data.mp4 import set_durations, set_rotation, write_mp4
from torchslam.data import Calibrated, open_sequence
from torchslam.data.readers import video
from torchslam.data.readers.video import VideoSequence, _rising
from torchslam.data.transforms import Selection
from torchslam.errors import CalibrationError, SequenceError
from torchslam.geometry.camera import Camera

CAMERA = "60,60,32,24"
MILLISECONDS = [40, 200, 17, 333, 5, 40, 81, 40]


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Eight frames, each of its own brightness."""
    path = tmp_path / "clip.mp4"
    write_mp4(path, [np.full((48, 64, 3), 30 * index, np.uint8) for index in range(8)])
    return path


def test_times_of_a_varying_rate(clip: Path) -> None:
    set_durations(clip, MILLISECONDS)
    sequence = open_sequence(clip, CAMERA)
    expected = np.cumsum([0, *MILLISECONDS[:-1]]) / 1000
    assert np.abs(sequence.timestamps.numpy() - expected).max() < 1e-6
    for index in (5, 2, 7):
        assert sequence[index].timestamp == pytest.approx(expected[index], abs=1e-6)
        assert float(sequence[index].image.mean()) == pytest.approx(30 * index / 255, abs=0.02)


@pytest.mark.parametrize(("degrees", "corner"), [(0, (0, 0)), (90, (0, -1)), (180, (-1, -1)), (270, (-1, 0))])
def test_rotation(tmp_path: Path, degrees: int, corner: tuple[int, int]) -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    image[:12, :12] = 255
    path = tmp_path / "turned.mp4"
    write_mp4(path, [image] * 3)
    set_rotation(path, degrees)
    sequence = open_sequence(path, "f=0.8w")
    assert sequence.size == ((64, 48) if degrees % 180 == 0 else (48, 64))
    assert float(sequence.camera.fx) == pytest.approx(0.8 * sequence.size[0])
    for index in (1, 0):  # going back opens the file anew
        shown = sequence.image(index)[0, 0]
        y, x = (4 if side == 0 else -5 for side in corner)
        assert shown[y, x] > 0.8
        assert float((shown > 0.5).float().mean()) == pytest.approx(144 / 3072, abs=0.02)


def test_frames_are_subsampled_by_time(clip: Path) -> None:
    set_durations(clip, MILLISECONDS)
    sequence = open_sequence(clip, CAMERA, fps=10)
    assert (sequence.timestamps * 1000).round().to(int).tolist() == [0, 240, 590, 716]
    part = open_sequence(clip, CAMERA, start="0.24s", stop="0:00.595")
    assert (part.timestamps * 1000).round().to(int).tolist() == [240, 257, 590]
    assert float(part[0].image.mean()) == pytest.approx(60 / 255, abs=0.02)


def test_a_video_is_read_without_a_camera(clip: Path) -> None:
    sequence = open_sequence(clip)
    assert sequence.calibrated is Calibrated.MISSING
    assert sequence.describe()["camera"].startswith("missing")
    assert open_sequence(clip, "fov=65").calibrated is Calibrated.GUESSED
    assert open_sequence(clip, CAMERA).calibrated is Calibrated.GIVEN


def test_a_camera_can_be_set_later(clip: Path) -> None:
    sequence, given = open_sequence(clip), open_sequence(clip, CAMERA).camera
    sequence.camera = given
    assert (sequence.camera, sequence.calibrated) == (given, Calibrated.GIVEN)
    with pytest.raises(CalibrationError, match="these are"):
        sequence.camera = Camera.pinhole(1, 1, 1, 1, size=(2, 2))


@pytest.mark.parametrize(
    ("options", "grabbed"),
    [
        ({"limit": 2}, 2),
        ({"limit": 2, "stride": 3}, 6),
        ({"start": 2, "limit": 2}, 4),
        ({"start": "0.25s", "limit": 1}, 4),
        ({"stop": 3}, 4),  # the frame after the last one is looked at
        ({"stop": "0.3s"}, 5),
        ({"fps": 10, "limit": 3}, 5),
        ({"start": 20}, 8),
        ({"stride": 2}, 8),
        ({}, 8),
    ],
)
def test_times_are_read_as_far_as_they_are_needed(
    clip: Path, options: dict, grabbed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is chosen is the same as of the whole video."""
    set_durations(clip, MILLISECONDS)
    whole = open_sequence(clip, CAMERA)
    counts: list[int] = []
    read_times = VideoSequence._read_times

    def counted(self: VideoSequence, *arguments) -> tuple:
        found = read_times(self, *arguments)
        counts.append(len(found[1]))
        return found

    monkeypatch.setattr(VideoSequence, "_read_times", counted)
    if options.get("start") == 20:
        with pytest.raises(SequenceError, match="no frames left of 8"):
            open_sequence(clip, CAMERA, **options)
    else:
        sequence = open_sequence(clip, CAMERA, **options)
        chosen = Selection(rate=options.pop("fps", None), **options).of(whole)
        assert sequence.timestamps.tolist() == chosen.timestamps.tolist()
        names, expected = ([each.image_name(i) for i in range(len(each))] for each in (sequence, chosen))
        assert names == expected
        assert sequence.notes == ()
    assert counts == [grabbed]


def test_masks_are_matched_by_the_order_of_all_frames(clip: Path, tmp_path: Path) -> None:
    for index in range(8):
        mask = np.full((48, 64), 255, np.uint8)
        mask[:, : 4 * index] = 0
        assert cv2.imwrite(str(tmp_path / f"mask{index}.png"), mask)
    sequence = open_sequence(clip, CAMERA, start=2, limit=2, mask=tmp_path)
    assert [int((~sequence.mask(index)).sum()) // 48 for index in range(2)] == [8, 12]


def test_a_long_video_shows_its_progress(
    clip: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    open_sequence(clip, CAMERA)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(video, "QUIET", 1e-6)
    monkeypatch.setattr("torchslam.utils.console.INTERVAL", 1e-6)
    monkeypatch.setattr(video, "MANY", 3)
    sequence = open_sequence(clip, CAMERA)
    assert "times of the frames of clip.mp4" in capsys.readouterr().err
    sequence.image(2)
    assert capsys.readouterr().err == ""
    sequence.image(7)
    assert "to frame 7 of clip.mp4" in capsys.readouterr().err


def test_opening_leaves_no_thread(clip: Path) -> None:
    """A process with threads cannot be forked."""
    code = (
        "import threading; from torchslam.data import open_sequence\n"
        f"open_sequence({str(clip)!r}).image(0); print(threading.active_count())"
    )
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True).stdout == b"1\n"


def test_frames_with_non_increasing_times_are_dropped() -> None:
    assert list(_rising([0.0, 0.1, 0.1, 0.05, 0.2, float("nan"), 0.3])) == [0, 1, 4, 6]
