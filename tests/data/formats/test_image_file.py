"""Image files: the marks of their end, thumbnails and fill bytes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from torchslam.data.formats.image_file import read_gray
from torchslam.errors import FrameError


@pytest.fixture
def jpeg(tmp_path: Path, write_picture: Callable) -> Path:
    path = tmp_path / "image.jpg"
    write_picture(path)
    return path


def _with_thumbnail(data: bytes, thumbnail: bytes) -> bytes:
    """The JPEG with another one inside an APP1 segment, as cameras write it."""
    segment = b"Exif\0\0" + thumbnail
    return data[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + data[2:]


def test_end_of_a_thumbnail_is_not_the_end_of_the_image(jpeg: Path) -> None:
    data = jpeg.read_bytes()
    both = _with_thumbnail(data, data)
    jpeg.write_bytes(both)
    assert read_gray(jpeg, "here").shape == (1, 1, 48, 64)
    jpeg.write_bytes(both[:-100])
    with pytest.raises(FrameError, match=r"here: .*image\.jpg is truncated"):
        read_gray(jpeg, "here")


def test_padding_after_the_end_and_before_markers_is_fine(jpeg: Path) -> None:
    data = jpeg.read_bytes()
    image = read_gray(jpeg, "here")
    jpeg.write_bytes(data[:2] + b"\xff\xff" + data[2:] + bytes(512))
    assert torch.equal(read_gray(jpeg, "here"), image)


def test_damaged_png(tmp_path: Path, write_picture: Callable) -> None:
    path = tmp_path / "image.png"
    write_picture(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(FrameError, match="damaged"):
        read_gray(path, "here")


def test_a_header_that_declares_too_many_pixels_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.pgm"
    path.write_bytes(b"P5\n3000000 3000000\n255\n" + bytes(100))
    with pytest.raises(FrameError, match="not an image"):
        read_gray(path, "here")


def test_color_becomes_gray_in_unit_range(tmp_path: Path, write_picture: Callable) -> None:
    write_picture(tmp_path / "image.png")
    image = read_gray(tmp_path / "image.png", "here")
    assert image.dtype == torch.float32
    assert 0 <= float(image.min()) < float(image.max()) <= 1
