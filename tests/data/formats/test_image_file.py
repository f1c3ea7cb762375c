"""Image files: the marks of their end, thumbnails and fill bytes."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchslam.data.formats.image_file import PNG_MAX_CHUNKS, read_color, read_gray
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


@pytest.mark.parametrize("reader", [read_gray, read_color])
@pytest.mark.parametrize("length", [2**31 - 1, 2**32 - 1, 3000])
def test_what_a_chunk_declares_beyond_the_file_is_not_allocated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: Callable, length: int
) -> None:
    path = tmp_path / "mask.png"
    cv2.imwrite(str(path), np.full((48, 64), 255, np.uint8), [cv2.IMWRITE_PNG_BILEVEL, 1])
    assert reader(path, "here").amax() > 0
    data = path.read_bytes()
    at = data.index(b"IDAT") - 4
    path.write_bytes(data[:at] + length.to_bytes(4, "big") + data[at + 4 :])
    monkeypatch.setattr(cv2, "imdecode", pytest.fail)
    with pytest.raises(FrameError, match="damaged"):
        reader(path, "here")


def test_the_chunks_of_a_png_are_counted(tmp_path: Path, write_picture: Callable) -> None:
    path = tmp_path / "image.png"
    write_picture(path)
    data = path.read_bytes()
    empty = bytes(4) + b"tEXt" + zlib.crc32(b"tEXt").to_bytes(4, "big")
    path.write_bytes(data[:33] + PNG_MAX_CHUNKS * empty + data[33:])
    with pytest.raises(FrameError, match="damaged"):
        read_gray(path, "here")


def test_color_becomes_gray_in_unit_range(tmp_path: Path, write_picture: Callable) -> None:
    write_picture(tmp_path / "image.png")
    image = read_gray(tmp_path / "image.png", "here")
    assert image.dtype == torch.float32
    assert 0 <= float(image.min()) < float(image.max()) <= 1
