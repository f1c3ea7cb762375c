"""Only regular files are read, and never more of one than there may be."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from torchslam.config import load_config
from torchslam.data import open_sequence, parse_camera, read_calibration, read_trajectory
from torchslam.data.formats.given_poses import read_poses
from torchslam.data.formats.image_file import read_gray
from torchslam.errors import LONGEST, TorchslamError
from torchslam.features.learned import XFeat
from torchslam.io.results import read_frames
from torchslam.map.file import read_atlas
from torchslam.utils.files import check_regular, parse_json, read_bytes, read_text

READERS: dict[str, Callable[[Path], object]] = {
    "trajectory": read_trajectory,
    "calibration": read_calibration,
    "image": lambda path: read_gray(path, str(path)),
    "poses": read_poses,
    "configuration": load_config,
    "map": read_atlas,
    "frames": read_frames,
    "weights": XFeat,
    "sequence": open_sequence,
    "mask": lambda path: open_sequence("synthetic:room?frames=2", mask=path),
    "camera": lambda path: parse_camera(str(path), (64, 48)),
}


@pytest.mark.parametrize("name", READERS)
def test_bounded_reads_neither_block_nor_run_forever(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    os.mkfifo(tmp_path / "pipe.mp4")
    (tmp_path / "endless").symlink_to("/dev/zero")
    (tmp_path / "circle").symlink_to("circle")
    for wrong in ("pipe", "pipe.mp4", "endless", "circle", "none", "a\0b", "\ud800", "x" * 300):
        with pytest.raises(TorchslamError) as caught:
            READERS[name](tmp_path / wrong)
        assert str(caught.value).isprintable()


def test_a_pipe_in_a_list_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "rgb.txt").write_text("0 a.png\n1 /dev/zero\n2 a\0.png\n")
    with pytest.raises(TorchslamError, match=r"rgb\.txt:1: .*a\.png cannot be read: not a regular file"):
        open_sequence(tmp_path)


def test_limits(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n")
    assert read_text(tmp_path / "a", 10, "a text") == "a\nb\nc\n"
    for read in (check_regular, read_bytes):
        with pytest.raises(OSError, match="has 10 bytes, more than the 9 of a text") as caught:
            read(tmp_path / "a", 9, "a text")
        assert caught.value.errno == errno.EFBIG
        with pytest.raises(OSError, match="Is a directory"):
            read(tmp_path, 9, "a text")
        with pytest.raises(OSError, match="file name contains a NUL character"):
            read(tmp_path / "a\0", 9, "a text")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="a file that does not know its size")
def test_a_file_of_size_zero_is_read() -> None:
    assert b"Name:" in read_bytes("/proc/self/status", 1 << 20, "a text")
    with pytest.raises(OSError, match="more than the 100 of a text"):
        read_bytes("/proc/self/status", 100, "a text")


@pytest.mark.parametrize("text", ["[" * 100_000, "{", "9" * 5000])
def test_json_that_python_cannot_parse_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        parse_json(text)


def test_a_message_is_one_line() -> None:
    assert str(TorchslamError("a\nb\x1b[1m\ud800\u2028é")) == "a\\nb\\x1b[1m\\ud800\\u2028é"
    for filling in ("x", "\n", "\ud800"):
        text = str(TorchslamError("start" + filling * 10_000_000 + "end"))
        assert text.startswith("start")
        assert text.endswith("end")
        assert " [...] " in text
        assert len(text) < LONGEST + 10
