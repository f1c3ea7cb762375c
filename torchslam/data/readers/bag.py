"""Recordings of ROS: bags of ROS 1 and 2, MCAP, through `rosbags` (the extra `bags`).

`robot.bag?topic=/cam1/image_raw` names one of several cameras.
"""

from __future__ import annotations

import contextlib
import itertools
import sys
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

import cv2
import numpy as np
from jaxtyping import Float, Shaped
from torch import Tensor

from torchslam.data.calibration import Calibration, GivenCamera
from torchslam.data.formats.calibration_files import checked
from torchslam.data.formats.image_file import MAX_BYTES, SAMPLES, bit_depth, decode_pixels, gray_to_tensor
from torchslam.data.sequence import Reader, Sequence
from torchslam.data.text_file import float64
from torchslam.errors import FrameError, SequenceError
from torchslam.utils.files import check_regular
from torchslam.utils.forks import forget_in_forks, never_release

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

SUFFIXES = frozenset({".bag", ".mcap", ".db3"})
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
MAX_MESSAGES = 2_000_000  # largest number of images: more than a day at 20 Hz

# https://docs.ros.org/en/api/sensor_msgs/html/image__encodings_8h_source.html: bytes per pixel, how to make them gray.
GRAY = {"mono8": np.uint8, "8UC1": np.uint8, "mono16": np.uint16}
COLORS = {
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "8UC4": (4, cv2.COLOR_BGRA2GRAY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2GRAY_YUY2),
    # OpenCV names a pattern by its second row.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
}


class BagSequence(Sequence):
    """Images of one topic, read in order; seeking backwards reads from the start again.

    `times` are those of its messages, seconds since 1970: stamps of the images, or when one without it was recorded.
    Raises SequenceError if no image can be read, CalibrationError for a camera of another size.
    """

    def __init__(
        self,
        path: Path,
        reader: Recording,
        connection: Connection,
        times: list[float],
        camera: GivenCamera | None,
    ) -> None:
        self._path, self._reader, self._connection = path, reader, connection
        # Messages may be recorded late: frames come in the order in which they were taken.
        messages: dict[float, int] = {}
        for message, time in enumerate(times):
            messages.setdefault(time, message)
        self._messages = [messages[time] for time in sorted(messages)]
        self._position, self._is_inherited = 0, False
        self._stream: Iterator[Any] = iter(())
        self._rewind()
        first, *others = sorted(self._messages)[:SAMPLES]
        image = self._read(first)
        self._bits = bit_depth(itertools.chain([image], map(self._read, others)))
        left_out = len(times) - len(messages)
        super().__init__(
            path.stem,
            f"ROS bag, {connection.topic}",
            camera,
            float64(sorted(messages)),
            size=(image.shape[1], image.shape[0]),
            notes=[f"left out {left_out} images whose time repeats"] if left_out else [],
        )

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {
            "_reader": None,
            "_stream": None,
            "_connection": self._connection.topic,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Raises SequenceError if the recording is gone."""
        self.__dict__.update(state)
        self._reader = _open_reader(self._path)
        self._connection = _connection(self._reader, state["_connection"])
        self._rewind()

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        try:
            gray = self._read(self._messages[index])
        except SequenceError as error:
            raise FrameError(str(error)) from error
        self._check_size(gray.shape, self.image_name(index))
        return gray_to_tensor(gray, self._bits)

    def image_name(self, index: int) -> str:
        return f"{self._path}{self._connection.topic}#{index}"

    def forget_handle(self) -> None:
        never_release(self._stream)
        never_release(self._reader)
        self._is_inherited, self._position = True, sys.maxsize  # so that the next image opens the file anew

    def close_decoder(self) -> None:
        """Do nothing: a file has no threads."""

    def _rewind(self) -> None:
        if self._is_inherited:
            self._reader, self._is_inherited = _open_reader(self._path), False
            self._connection = _connection(self._reader, self._connection.topic)
        forget_in_forks(self)
        self._stream, self._position = self._reader.messages([self._connection]), 0

    def _read(self, message: int) -> Shaped[np.ndarray, "H W"]:
        """Return the gray pixels of a message, by its index in the recording."""
        if message < self._position:
            self._rewind()
        where = f"{self._path}{self._connection.topic}, message {message}"
        with _errors(where):
            while self._position <= message:
                _, _, raw = next(self._stream)
                self._position += 1
            content: Any = self._reader.deserialize(raw, self._connection.msgtype)
            if self._connection.msgtype == COMPRESSED:
                gray = decode_pixels(content.data[:MAX_BYTES].tobytes())
                if gray is None:
                    raise SequenceError(f"{where}: `{content.format}` is not an image, or a damaged one")
                return gray
            return to_gray(content, where)


def to_gray(message: Any, where: str) -> Shaped[np.ndarray, "H W"]:
    """A sensor_msgs/Image as gray, uint8 or uint16. Raises SequenceError at `where` for other encodings."""
    encoding, step = message.encoding, message.step
    height, width = message.height, message.width
    if encoding in GRAY:
        kind = np.dtype(GRAY[encoding])
        channels, pixels = 1, kind.newbyteorder(">" if message.is_bigendian else "<")
    elif encoding in COLORS:
        channels, pixels = COLORS[encoding][0], np.dtype(np.uint8)
    else:
        known = ", ".join([*GRAY, *COLORS])
        raise SequenceError(f"{where}: encoding `{encoding}` is not read; there are {known}")
    row = width * channels * pixels.itemsize
    if min(height, width) < 1 or step < row or len(message.data) < height * step:
        raise SequenceError(
            f"{where}: {len(message.data)} bytes are too few for {width}x{height} of {encoding}"
        )
    rows = np.frombuffer(message.data, np.uint8, height * step).reshape(height, step)[:, :row]
    image = np.ascontiguousarray(rows).view(pixels)
    if encoding in GRAY:
        return image.astype(GRAY[encoding])
    image = image.reshape(height, width, channels) if channels > 1 else image
    return cv2.cvtColor(image, COLORS[encoding][1])


class Recording:
    """An open recording whose messages are read as ROS defines them.

    Definitions in the recording itself are not followed: what a definition declares, such as an array of 10^9 texts,
    would take any time and memory.
    """

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore

        self._is_ros1 = path.suffix.lower() == ".bag"
        self._types = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.ROS2_HUMBLE)
        self._reader: Reader1 | Reader2 = Reader1(path) if self._is_ros1 else Reader2(path)
        self._reader.open()
        weakref.finalize(self, self._reader.close)  # when no sequence needs it anymore
        self.connections, self.messages = self._reader.connections, self._reader.messages
        read = self._types.deserialize_ros1 if self._is_ros1 else self._types.deserialize_cdr
        self.deserialize: Callable[[bytes, str], Any] = read

    def check_definition(self, connection: Connection) -> None:
        """Raise ValueError if the messages of a topic are not as ROS defines them, by the digest of a definition."""
        own = (
            self._types.generate_msgdef(connection.msgtype)[1]
            if self._is_ros1
            else self._types.hash_rihs01(connection.msgtype)
        )
        if connection.digest and connection.digest != own:
            raise ValueError(f"{connection.msgtype} with another definition, {connection.digest[:100]}")


def _open_reader(path: Path) -> Recording:
    try:
        import rosbags.highlevel  # noqa: F401  # is there one?
    except ImportError:
        raise SequenceError(f"{path}: ROS bags need `pip install torchslam[bags]`") from None
    with _errors(str(path)):
        # A file each minute for six days.
        for file in itertools.islice(path.iterdir(), 10_000) if path.is_dir() else (path,):
            if not file.is_dir():
                limit = 1 << 22 if file.name == "metadata.yaml" else 1 << 44
                check_regular(file, limit, "a file of a recording")
        return Recording(path)  # a single ROS 2 file is part of a recording folder or a complete recording


def _image_topics(reader: Recording) -> list[Connection]:
    return [each for each in reader.connections if each.msgtype in (IMAGE, COMPRESSED)]


def _connection(reader: Recording, topic: str) -> Connection:
    """Return the connection of an image topic."""
    return next(each for each in _image_topics(reader) if each.topic == topic)


def _is_bag(path: str) -> bool:
    """Return True for a bag file and for the folder of a ROS 2 recording."""
    source = Path(path.partition("?topic=")[0])
    return (source.suffix.lower() in SUFFIXES and source.exists()) or (source / "metadata.yaml").is_file()


def _open_bag(path: str, camera: GivenCamera | None, rate: float | None) -> BagSequence:
    """Open the images of a recording; without `camera`, its camera_info is used.

    Raises SequenceError for a damaged file, one without images, and where it must be said which of several topics.
    """
    name, _, query = path.partition("?")
    wanted = dict(parse_qsl(query)).get("topic")
    reader = _open_reader(Path(name))
    if not all(isinstance(each.topic, str) for each in reader.connections):
        raise SequenceError(f"{name}: cannot be read: topics without a name")
    images = [each.topic for each in _image_topics(reader)]
    topics = list(dict.fromkeys(topic for topic in images if "depth" not in topic.lower()))
    if wanted is not None:
        topics = [wanted] if wanted in images else []
    if not topics:
        there = ", ".join(sorted(set(images))) or "none"
        raise SequenceError(f"{name}: no images on {wanted or 'any topic'}; topics of images: {there}")
    if len(topics) > 1:
        proposals = " or ".join(f"'{name}?topic={topic}'" for topic in topics[:6])
        raise SequenceError(f"{name}: {len(topics)} topics of images; choose one: {proposals}")
    connection = _connection(reader, topics[0])
    calibration = _read_calibration(reader, name, connection.topic)
    times: list[float] = []
    with _errors(name):
        reader.check_definition(connection)
        for _, recorded, raw in reader.messages([connection]):
            if len(times) == MAX_MESSAGES:
                raise SequenceError(f"{name}: more than {MAX_MESSAGES} images")
            stamp = reader.deserialize(raw, connection.msgtype).header.stamp
            times.append((stamp.sec * 1_000_000_000 + stamp.nanosec or recorded) / 1e9)
    if not times:
        raise SequenceError(f"{name}: no images on {connection.topic}")
    return BagSequence(Path(name), reader, connection, times, calibration if camera is None else camera)


def _read_calibration(reader: Recording, path: str, topic: str) -> Calibration | None:
    """Read the first camera_info beside an image topic; None without one."""
    info_topic = topic.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
    kind, name = "sensor_msgs/msg/CameraInfo", f"{path}{info_topic}"
    infos = [each for each in reader.connections if each.msgtype == kind and each.topic == info_topic]
    is_rectified = "rect" in topic.rpartition("/")[2] or "_rect" in topic
    with _errors(path):
        for info in infos[:1]:
            reader.check_definition(info)
        for _, _, raw in reader.messages(infos) if infos else ():
            return from_camera_info(reader.deserialize(raw, kind), name, is_rectified)
    return None


def from_camera_info(message: Any, source: str, rectified: bool) -> Calibration | None:
    """The calibration in a sensor_msgs/CameraInfo; None if it is all zero, as drivers without a calibration send it.

    The projection P, without distortion, is that of rectified images.
    """
    # ROS 1 has upper-case names.
    K, D, P = (getattr(message, name if hasattr(message, name) else name.lower()) for name in "KDP")
    if K[0] <= 0:
        return None
    size = (int(message.width), int(message.height)) if message.width and message.height else None
    if rectified and P[0] > 0:
        return Calibration.from_numbers([P[0], P[5], P[2], P[6]], source, size=size)
    intrinsics = [float(value) for value in (K[0], K[4], K[2], K[5])]
    return checked(intrinsics, [float(value) for value in D], source, message.distortion_model, size)


@contextlib.contextmanager
def _errors(where: str) -> Iterator[None]:
    """Convert any exception of the reader to SequenceError at `where`: damaged files can raise anything."""
    try:
        yield
    except SequenceError:
        raise
    except StopIteration:
        raise SequenceError(f"{where}: the recording ends before it") from None
    except Exception as cause:  # rosbags and the decompressors below it have no common error
        raise SequenceError(f"{where}: cannot be read: {type(cause).__name__}: {cause}") from cause


BAG = Reader("a ROS bag (.bag, .mcap, or a folder with metadata.yaml)", _is_bag, _open_bag)
