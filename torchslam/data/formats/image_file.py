"""Image files and image arrays as gray or color tensors.

Plain PNG files are decoded two to four times faster than by OpenCV, to the same pixels. Truncated files are errors.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import kornia_rs
import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from PIL import Image
from torch import Tensor

from torchslam.errors import FrameError, ResultsError
from torchslam.utils.files import check_regular, read_bytes

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})
FOREIGN = frozenset(
    {".heic", ".heif", ".avif", ".jxl", ".jp2", ".gif", ".exr", ".hdr", ".dng"}
    | {".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}
)
"""Suffixes of images that are not read."""
AS_GRAY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
AS_COLOR = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
AS_STORED = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
"""Channels and numbers of the file, floats too."""
MAX_BYTES = 1 << 29  # size limit of image files
MAX_PIXELS = 1 << 26  # maximum number of pixels; a small file may declare any number


def write_image(path: Path, pixels: UInt8[np.ndarray, "H W *channels"], options: Sequence[int] = ()) -> None:
    """Write gray or BGR pixels in the format that the suffix names; any name of a folder will do.

    `options` are OpenCV's of the format: alternating flags and values. OpenCV's own writer takes UTF-8 names only, and
    reports a failure by its return value. Raises ResultsError.
    """
    is_encoded, content = cv2.imencode(path.suffix, pixels, options)
    try:
        if not is_encoded:
            raise OSError(f"OpenCV cannot encode {path.suffix}")
        path.write_bytes(content.tobytes())
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written: {error.strerror or error}") from error


def read_gray(
    path: str | Path, where: str, bits: int = 8, as_stored: bool = False
) -> Float[Tensor, "1 1 H W"]:
    """An image file as gray in [0, 1].

    `bits` are those of files of 16 bits that carry something (`bit_depth`); `as_stored` ignores the orientation in the
    EXIF block. Raises FrameError at `where` for a file that is missing, truncated, too large or not an image.
    """
    return gray_to_tensor(read_pixels(path, where, as_stored), bits)


def read_color(
    path: str | Path, where: str, bits: int = 8, as_stored: bool = False
) -> UInt8[Tensor, "H W 3"]:
    """An image file as red, green, blue; arguments and errors are those of `read_gray`."""
    image = read_pixels(path, where, as_stored, AS_COLOR)
    if image.dtype == np.uint16:
        image = np.rint(image * np.float32(255 / _white(bits))).clip(max=255).astype(np.uint8)
    return bgr_to_tensor(image)


def read_pixels(
    path: str | Path, where: str, as_stored: bool = False, flags: int = AS_GRAY
) -> Shaped[np.ndarray, "H W *channels"]:
    """An image file as gray, or as OpenCV's flags say, uint8, uint16, or with AS_STORED floats.

    Raises FrameError as `read_gray`.
    """
    try:
        data = read_bytes(path, MAX_BYTES, "an image that is read")
    except OSError as cause:
        raise FrameError(f"{where}: {path} cannot be read: {cause.strerror}") from cause
    if _is_truncated(data):
        raise FrameError(f"{where}: {path} is truncated: its end marker is missing")
    image = decode_pixels(data, flags | cv2.IMREAD_IGNORE_ORIENTATION if as_stored else flags)
    if image is None:
        raise FrameError(f"{where}: {path} is not an image, or a damaged one")
    return image


def has_transparency(path: Path) -> bool:
    """Return whether an image file has pixels that are not opaque. Raises FrameError as `read_gray`."""
    image = read_pixels(path, str(path), flags=cv2.IMREAD_UNCHANGED)
    return image.shape[2:] == (4,) and int(image[..., 3].min()) < np.iinfo(image.dtype).max


def is_turned(path: Path, as_stored: bool) -> bool:
    """Return whether an image is read in another orientation than its pixels are stored in.

    Raises FrameError if the file cannot be read.
    """
    try:
        check_regular(path, MAX_BYTES, "an image that is read")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                if as_stored and image.format != "TIFF":  # which OpenCV always turns
                    return False
                # Pillow would decode a PNG in search of a block after the pixels.
                is_searched = image.format != "PNG" or "exif" in image.info
                return is_searched and image.getexif().get(0x0112, 1) != 1  # the orientation
    except Exception as cause:  # a damaged block fails in any way
        raise FrameError(f"{path}: its EXIF block cannot be read: {cause}") from cause


def exif_block(path: Path, block: int) -> dict[int, Any]:
    """Return the values of a block of EXIF data by tag, of the block with a tag of its own.

    Raises FrameError if the file cannot be read.
    """
    try:
        content = read_bytes(path, MAX_BYTES, "an image that is read")
        with Image.open(io.BytesIO(content)) as image:
            return image.getexif().get_ifd(block)
    except Exception as cause:  # a damaged block fails in any way
        raise FrameError(f"{path}: its EXIF block cannot be read: {cause}") from cause


def decode_pixels(data: bytes, flags: int = AS_GRAY) -> np.ndarray | None:
    """An image file's bytes as (H, W) gray, or as OpenCV's flags say, uint8, uint16, or with AS_STORED floats.

    None for anything that is not a whole image.
    """
    if not data or not _has_whole_chunks(data) or _declared_pixels(data) > MAX_PIXELS:
        return None
    if flags & ~cv2.IMREAD_IGNORE_ORIENTATION == AS_GRAY and (gray := decode_png_gray(data)) is not None:
        return gray
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError):  # a header that promises more pixels than OpenCV takes
        return None
    kinds = (np.uint8, np.uint16, *((np.float32, np.float64) if flags == AS_STORED else ()))
    return image if image is not None and image.dtype in kinds else None


SAMPLES = 20  # number of images in which the brightest pixel of a 16-bit sequence is searched


def bit_depth(images: Iterable[np.ndarray]) -> int:
    """Return the number of significant bits: 8, or 10 to 16 by the brightest pixel of images of 16 bits."""
    brightest = max((int(image.max()) for image in images if image.dtype == np.uint16), default=0)
    return 8 if brightest == 0 else next(bits for bits in (10, 12, 14, 16) if brightest < 1 << bits)


def gray_to_tensor(gray: Shaped[np.ndarray, "H W"], bits: int = 8) -> Float[Tensor, "1 1 H W"]:
    """Convert uint8, or uint16 of which `bits` carry something, to float32 in [0, 1]."""
    if gray.dtype == np.uint16:
        floats = gray.astype(np.float32)
        floats /= _white(bits)  # in place: of a large image one copy less
        return torch.from_numpy(floats).clamp_(max=1.0)[None, None]
    return torch.from_numpy(gray).to(torch.float32).div_(255.0)[None, None]


def _white(bits: int) -> int:
    return (1 << bits) - 1 if bits > 8 else 65535


def bgr_to_tensor(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    """Convert blue, green, red, the order of OpenCV, to red, green, blue."""
    return torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def _declared_pixels(data: bytes) -> int:
    """Return the number of pixels that a header declares; more than the limit if it cannot be read."""
    if data.startswith((b"II*\0", b"MM\0*")):
        return _tiff_pixels(data)
    if data.startswith(b"v/1\x01"):  # OpenEXR: the window is two corners, which belong to it
        window = data.partition(b"dataWindow\0box2i\0\x10\0\0\0")[2][:16].ljust(16, b"\0")
        left, top, right, bottom = struct.unpack("<4i", window)
        return (right - left + 1) * (bottom - top + 1) if right > left and bottom > top else MAX_PIXELS + 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large images: these have their limit
            with Image.open(io.BytesIO(data)) as image:
                return image.width * image.height
    except Exception:  # a damaged header fails in any way
        return MAX_PIXELS + 1


def _tiff_pixels(data: bytes) -> int:
    """Return the pixels of the first page of a TIFF, since Pillow does not open all kinds that OpenCV reads.

    Source: TIFF 6.0, section 2.
    """
    order: Literal["little", "big"] = "little" if data.startswith(b"II") else "big"

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], order)

    start = number(4, 4)
    sides = {256: 0, 257: 0}  # tags: width and height
    for at in range(start + 2, start + 2 + 12 * number(start, 2), 12):
        if number(at, 2) in sides:  # entries: tag, type (3: two bytes, 4: four), count, value
            sides[number(at, 2)] = number(at + 8, 2 if number(at + 2, 2) == 3 else 4)
    return sides[256] * sides[257] or MAX_PIXELS + 1


def _is_truncated(data: bytes) -> bool:
    """Return True for a JPEG or PNG file without its end marker; other formats are left to the decoder."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:] and b"IEND\xaeB`\x82" not in data
    if not data.startswith(b"\xff\xd8"):
        return False
    position = 2  # to the pixels of a JPEG, after any embedded thumbnail
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xDA:
            return data.rfind(b"\xff\xd9") < position
        # 0xFF is a fill byte.
        position += 1 if marker == 0xFF else 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return True


CHANNELS = {
    "gray": None,
    "rgb": cv2.COLOR_RGB2GRAY,
    "bgr": cv2.COLOR_BGR2GRAY,
    "rgba": cv2.COLOR_RGBA2GRAY,
    "bgra": cv2.COLOR_BGRA2GRAY,
}
"""Orders of channels, and how OpenCV makes them gray."""


def image_tensor(
    image: Shaped[np.ndarray, "H W *channels"], channels: str = "rgb"
) -> Float[Tensor, "1 1 H W"]:
    """Convert an array, uint8 or floats in [0, 1], to gray in [0, 1].

    `channels` is their order, one of CHANNELS; ignored for an image with one channel. Raises FrameError for another
    shape or type, and for floats that are not in [0, 1].
    """
    array = np.asarray(image)
    if channels not in CHANNELS:
        raise FrameError(f"channels must be one of {', '.join(CHANNELS)}, not {channels!r}")
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    expected = len(channels)
    if 0 in array.shape or not (
        array.ndim == 2 or (array.ndim == 3 and array.shape[2] == expected and channels != "gray")
    ):
        raise FrameError(
            f"an image must be (H, W), or (H, W, {expected}) for channels {channels!r}, not {array.shape}"
        )
    if array.dtype != np.uint8 and array.dtype.kind != "f":
        raise FrameError(
            f"an image must be uint8, or floats in [0, 1], not {array.dtype}: divide it by what is white in it"
        )
    if array.dtype.kind == "f":
        array = array.astype(np.float32)
        if not (array.min() >= 0 and array.max() <= 1):  # also for NaN
            raise FrameError(f"floats must be in [0, 1], these are from {array.min():g} to {array.max():g}")
    code = CHANNELS[channels]
    gray = array if array.ndim == 2 or code is None else cv2.cvtColor(np.ascontiguousarray(array), code)
    tensor = torch.from_numpy(np.ascontiguousarray(gray).astype(np.float32))
    return (tensor / 255.0 if array.dtype == np.uint8 else tensor)[None, None]


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_MAX_CHUNKS = 1 << 17
"""Largest number of chunks of a file: libpng writes one for 8 kB of pixels, which are at most 1 GB."""
TO_GRAY = np.array([[9797, 19234, 3737, 0.5 - 16384]], np.float32) / 32768
"""Red, green, blue to gray as OpenCV has libpng do it: 0.299, 0.587 and the rest of 32768, rounded down. Half of a
32768th more than -1/2 makes the rounding of `cv2.transform` that; all sums are whole in float32."""


def decode_png_gray(data: bytes) -> Shaped[np.ndarray, "H W"] | None:
    """Decode a plain PNG file (gray of 8 or 16 bits, color of 8) to gray, uint8 or uint16.

    None for any other file, and for a damaged one: then OpenCV has to say. That is: without a sound header, interlaced,
    or with chunks that change its pixels. An image is made of the size that a sound header promises, so who calls this
    has looked at that. Source: PNG specification, sections 5 and 11.
    """
    header, sum_ = data[12:29], data[29:33]
    is_sound = (
        data.startswith(PNG_SIGNATURE + b"\0\0\0\rIHDR")  # of 13 bytes
        and zlib.crc32(header).to_bytes(4, "big") == sum_
        and any(data[16:20])
        and any(data[20:24])
    )
    # Chunks before the pixels that change none of them. Others (of gamma, transparency, animation) are left to OpenCV.
    plain = (b"IHDR", b"pHYs", b"tEXt", b"zTXt", b"iTXt", b"tIME")
    first = next((name for name, _ in _png_chunks(data) if name not in plain), b"")
    if not is_sound or header[-1] or first != b"IDAT":  # the last byte of the header: interlaced
        return None
    size = int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big")
    try:
        match data[24], data[25]:  # bits, and type of color
            case 16, 0:
                return kornia_rs.io.decode_image_png_u16(data, size, "mono")[..., 0]
            case 8, 0:
                return kornia_rs.io.decode_image_png_u8(data, size, "mono")[..., 0]
            case 8, 2:
                rgb = kornia_rs.io.decode_image_png_u8(data, size, "rgb")
                return cv2.transform(rgb, TO_GRAY).reshape(size)
    except Exception:  # the decoder has no exception type
        pass
    return None


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield the name of each chunk of a PNG file, and where it ends, until the last one or the end of the file."""
    end = len(PNG_SIGNATURE)
    for _ in range(PNG_MAX_CHUNKS):
        name = data[end + 4 : end + 8]
        end += 12 + int.from_bytes(data[end : end + 4], "big")
        yield name, end  # around its content are its length, its name and a sum
        if name == b"IEND" or end > len(data):
            return


def _has_whole_chunks(data: bytes) -> bool:
    """Return False for a PNG file with a chunk that reaches beyond its end: OpenCV allocates what a chunk declares."""
    if not data.startswith(PNG_SIGNATURE):
        return True
    *_, (name, end) = _png_chunks(data)
    return name == b"IEND" and end <= len(data)
