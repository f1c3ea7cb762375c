"""Plain PNG files have the pixels that OpenCV reads from them; all others are left to it."""

from __future__ import annotations

import io
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from torchslam.data.formats.image_file import AS_GRAY, decode_pixels, decode_png_gray


def by_opencv(data: bytes) -> np.ndarray | None:
    return cv2.imdecode(np.frombuffer(data, np.uint8), AS_GRAY)


def encoded(image: np.ndarray, **options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", **options)
    return file.getvalue()


@pytest.mark.parametrize(
    ("shape", "dtype"), [((37, 53), np.uint8), ((37, 53), np.uint16), ((37, 53, 3), np.uint8)]
)
@pytest.mark.parametrize("seed", range(3))
def test_same_pixels_as_opencv(shape: tuple[int, ...], dtype: type, seed: int) -> None:
    noise = np.random.default_rng(seed).integers(0, np.iinfo(dtype).max + 1, shape)
    image: np.ndarray = noise.astype(dtype)
    data = encoded(image)
    gray = decode_png_gray(data)
    assert gray is not None
    assert gray.dtype == dtype
    np.testing.assert_array_equal(gray, by_opencv(data))


def test_color_to_gray_agrees_with_opencv() -> None:
    levels = np.arange(0, 256, 5, dtype=np.uint8)
    colors = np.stack(np.meshgrid(levels, levels, np.arange(256, dtype=np.uint8), indexing="ij"), -1)
    data = encoded(colors.reshape(len(levels), -1, 3))
    np.testing.assert_array_equal(decode_png_gray(data), by_opencv(data))


def test_text_chunks_before_the_pixels_are_ignored() -> None:
    text = PngImagePlugin.PngInfo()
    text.add_text("camera", "left")
    image = np.arange(256, dtype=np.uint8).reshape(8, 32)
    np.testing.assert_array_equal(decode_png_gray(encoded(image, pnginfo=text, dpi=(72, 72))), image)


def test_chunks_that_change_pixels_are_left_to_opencv() -> None:
    colors = np.arange(192, dtype=np.uint8).reshape(8, 8, 3)
    gamma = PngImagePlugin.PngInfo()
    gamma.add(b"gAMA", (45455).to_bytes(4, "big"))
    for data in (
        encoded(colors, pnginfo=gamma),
        encoded(np.dstack([colors, colors[..., :1]])),  # transparent
        encoded(np.eye(8, dtype=bool)),  # of one bit
        cv2.imencode(".jpg", colors)[1].tobytes(),
        b"",
    ):
        assert decode_png_gray(data) is None
    data = encoded(colors, pnginfo=gamma)
    np.testing.assert_array_equal(decode_pixels(data), by_opencv(data))


@settings(max_examples=300, deadline=None)
@given(st.integers(8, 400), st.integers(0, 255), st.integers(0, 400))
def test_damaged_files_are_never_read_as_valid(at: int, value: int, lost: int) -> None:
    data = bytearray(encoded(np.arange(400, dtype=np.uint8).reshape(20, 20)))
    data[at % len(data)] = value
    gray = decode_png_gray(bytes(data[: len(data) - lost % len(data)]))
    if gray is not None:
        theirs = by_opencv(bytes(data))
        assert theirs is None or np.array_equal(gray, theirs)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 100), st.integers(0, 100), st.binary(min_size=5, max_size=5))
def test_unsupported_headers_are_left_to_opencv(width: int, height: int, kind: bytes) -> None:
    data = bytearray(encoded(np.arange(400, dtype=np.uint8).reshape(20, 20)))
    data[16:29] = width.to_bytes(4, "big") + height.to_bytes(4, "big") + kind
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    gray, theirs = decode_png_gray(bytes(data)), by_opencv(bytes(data))
    assert gray is None or theirs is None or np.array_equal(gray, theirs)


def test_a_header_that_declares_too_many_pixels_is_not_decoded() -> None:
    data = bytearray(encoded(np.zeros((8, 8), np.uint8)))
    data[16:20] = (1 << 30).to_bytes(4, "big")
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    assert decode_pixels(bytes(data)) is None
