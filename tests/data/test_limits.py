"""Small files that promise much: what they promise is not believed, or is not kept."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data.mp4 import edited, write_mp4
from torchslam.data import open_sequence, read_calibration
from torchslam.data.calibration import parse_numbers
from torchslam.data.readers import video
from torchslam.data.readers.video import claimed_samples
from torchslam.errors import CalibrationError, SequenceError, TrajectoryError

CAMERA = "60,60,32,24"


@pytest.fixture
def film(tmp_path: Path) -> Path:
    write_mp4(tmp_path / "film.mp4", [np.full((48, 64, 3), 40 * index, np.uint8) for index in range(5)])
    return tmp_path / "film.mp4"


def stsz(body: bytes) -> bytes:  # all samples of one byte, as many as there are numbers
    return struct.pack(">III", 0, 1, 134_000_000)


def stts(body: bytes) -> bytes:
    return struct.pack(">IIII", 0, 1, 134_000_000, 1)


def many_runs(body: bytes) -> bytes:  # together too many
    return struct.pack(">II", 0, 1000) + struct.pack(">II", 100_000, 1) * 1000


def of_all(body: bytes) -> bytes:  # more runs than there is room for
    return struct.pack(">II", 0, 2**32 - 1) + struct.pack(">II", 100_000_000, 1)


@pytest.mark.parametrize(
    ("kind", "change"), [(b"stsz", stsz), (b"stts", stts), (b"stts", many_runs), (b"stts", of_all)]
)
def test_an_index_with_more_frames_than_bytes_is_refused(
    film: Path, kind: bytes, change: Callable[[bytes], bytes]
) -> None:
    assert claimed_samples(film) == 5
    assert len(open_sequence(film, CAMERA)) == 5
    film.write_bytes(edited(film.read_bytes(), lambda name, body: change(body) if name == kind else body))
    with pytest.raises(
        SequenceError, match=r"film\.mp4: damaged: its index declares 1\d{8} frames, but the file has"
    ):
        open_sequence(film, CAMERA)


def test_endless_mp4_boxes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "boxes.mp4"
    large = struct.pack(">I4sQ", 1, b"moov", 2**63)
    to_the_end = struct.pack(">I4s", 0, b"trak")
    for content in (
        b"",
        b"\0" * 7,
        b"\0" * 100,
        to_the_end * 50_000,
        large * 1000,
        struct.pack(">I4s", 8, b"free") * 50_000,
    ):
        path.write_bytes(content)
        start = time.process_time()
        assert claimed_samples(path) == 0
        assert time.process_time() - start < 5


def test_frames_of_a_video_that_are_too_large(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "MAX_PIXELS", 64 * 48 - 1)
    with pytest.raises(SequenceError, match=r"film\.mp4: frames of 64x48, more than the 3071 pixels"):
        open_sequence(film, CAMERA)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="measured as Linux does")
def test_large_images_are_not_cached(tmp_path: Path) -> None:
    """Of 16 bits, twenty are looked at to learn how many are used: one after the other."""
    side = 2048
    cv2.imwrite(str(tmp_path / "0.png"), np.full((side, side), 1000, np.uint16))
    for index in range(1, 22):
        os.link(tmp_path / "0.png", tmp_path / f"{index}.png")
    # What a first call loads for good, 23 MB, is not measured.
    open_sequence(tmp_path, "1000,1000,1023.5,1023.5")
    Path("/proc/self/clear_refs").write_text("5")
    before = resident("VmRSS")
    sequence = open_sequence(tmp_path, "1000,1000,1023.5,1023.5")
    assert sequence.notes == ("10 of 16 bits are used",)
    assert resident("VmHWM") - before < 8 * 2 * side * side


def resident(key: str) -> int:
    """Bytes."""
    return int(Path("/proc/self/status").read_text().partition(f"{key}:")[2].split()[0]) * 1024


def test_long_lines_are_refused(tmp_path: Path) -> None:
    start = time.process_time()
    with pytest.raises(CalibrationError, match="here: 200000 characters, more than the 65536 of a line"):
        parse_numbers("1 " * 100_000, "here")
    (tmp_path / "c.yaml").write_text("camera_matrix:\n" + "\n" * 100_000)
    with pytest.raises(CalibrationError, match="matrix has 9 numbers, not 0"):
        read_calibration(tmp_path / "c.yaml")
    (tmp_path / "c.yaml").write_text("\n" * 300_000)
    with pytest.raises(CalibrationError, match="has 300000 bytes, more than the 262144 of a text"):
        read_calibration(tmp_path / "c.yaml")
    assert time.process_time() - start < 5


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1 1e300", "farther away than 1e\\+12"),
        ("1 0 0 0 0 1 0 0 0 0 7 0", "not a rigid transformation"),
        ("1e200 0 0 0 0 1e200 0 0 0 0 1e200 0", "not a rigid transformation"),
    ],
)
def test_invalid_poses_are_refused(tmp_path: Path, poses: str, message: str) -> None:
    (tmp_path / "image_0").mkdir()
    for index in range(2):
        cv2.imwrite(str(tmp_path / "image_0" / f"{index}.png"), np.zeros((48, 64), np.uint8))
    (tmp_path / "times.txt").write_text("0\n1\n")
    (tmp_path / "poses.txt").write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{poses}\n")
    with pytest.raises(TrajectoryError, match=rf"poses\.txt: .*{message}"):
        open_sequence(tmp_path, CAMERA)
