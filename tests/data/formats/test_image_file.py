"""Image files: the marks of their end, thumbnails and fill bytes."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from torchslam.data import open_sequence
from torchslam.data.formats.given_poses import read_poses
from torchslam.data.formats.image_file import PNG_MAX_CHUNKS, is_turned, read_color, read_gray, write_image
from torchslam.errors import FrameError, ResultsError, TrajectoryError


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


def test_colors_of_16_bits_are_measured_in_all_channels(tmp_path: Path) -> None:
    """Of a blue sky gray would be darker than blue, which would then be clipped."""
    image = np.zeros((48, 64, 3), np.uint16)
    image[:24] = (4000, 300, 100)  # blue, green, red
    cv2.imwrite(str(tmp_path / "0.png"), image)
    sequence = open_sequence(tmp_path)
    assert sequence.notes == ("12 of 16 bits are used",)
    assert sequence.color(0)[0, 0].tolist() == [6, 19, 249]
    gray = (0.114 * 4000 + 0.587 * 300 + 0.299 * 100) / 4095
    assert float(sequence.image(0)[0, 0, 0, 0]) == pytest.approx(gray, abs=1e-3)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_the_orientation_of_exif_is_ignored_on_request(tmp_path: Path, suffix: str) -> None:
    pixels = np.zeros((48, 64), np.uint8)
    pixels[:16, :16] = 200
    exif, path = Image.Exif(), tmp_path / f"a.{suffix}"
    exif[0x0112] = 3  # turned by 180 degrees
    Image.fromarray(pixels).convert("RGB").save(path, exif=exif)
    for image in (read_gray(path, "")[0, 0], read_color(path, "")[..., 1] / 255.0):
        assert float(image[-8, -8]) > 0.7 > 0.1 > float(image[8, 8])
    assert is_turned(path, as_stored=False)
    assert is_turned(path, as_stored=True) == (suffix == "tif")
    if suffix != "tif":
        for image in (read_gray(path, "", 8, True)[0, 0], read_color(path, "", 8, True)[..., 1] / 255.0):
            assert float(image[8, 8]) > 0.7 > 0.1 > float(image[-8, -8])
    del exif[0x0112]
    Image.fromarray(pixels).save(path, exif=exif)
    assert not is_turned(path, as_stored=False)


def test_images_are_read_as_colmap_read_them(tmp_path: Path) -> None:
    """It ignores the orientation, so its camera and poses are of the images as they are stored."""
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8), np.uint8).repeat(8, 0).repeat(8, 1)
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "images").mkdir()
    for index in range(2):
        Image.fromarray(pixels).save(tmp_path / "images" / f"{index}.jpg", exif=exif, quality=95)
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 64 48 60 32 24\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 0.jpg\n\n2 1 0 0 0 1 0 0 1 1.jpg\n\n")
    shown, given = open_sequence(tmp_path / "images"), read_poses(tmp_path)
    stored = open_sequence(tmp_path / "images", tmp_path / "cameras.txt")
    assert (shown.size, stored.size, stored.part(0, 1).as_stored) == ((48, 64), (64, 48), True)
    assert np.abs(stored.image(0)[0, 0].numpy() * 255 - pixels).max() < 20
    assert torch.equal(stored.color(0).rot90(-1), shown.color(0))
    assert given.rows(stored).tolist() == [0, 1]
    with pytest.raises(
        TrajectoryError, match=r"0\.jpg: its EXIF orientation turns it, which .* ignores: open"
    ):
        given.rows(shown)


def test_images_are_written_into_folders_whose_name_is_not_utf8(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xe9t\xe9"))
    folder.mkdir()
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    write_image(folder / "a.png", pixels)
    assert np.array_equal(cv2.imdecode(np.fromfile(folder / "a.png", np.uint8), cv2.IMREAD_COLOR), pixels)
    with pytest.raises(ResultsError, match="cannot be written: No such file or directory"):
        write_image(folder / "missing" / "a.png", pixels)
