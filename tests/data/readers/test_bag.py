"""Recordings of ROS 1 and 2 and MCAP, written with rosbags."""

from __future__ import annotations

import pickle
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from torchslam.data import Calibrated, open_sequence
from torchslam.data.readers.bag import COLORS, to_gray
from torchslam.errors import CalibrationError, SequenceError

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

STAMPS = [1_600_000_000_123_456_789, 1_600_000_000_163_000_000, 1_600_000_000_203_456_000]
BROWN = np.array([0.1, -0.2, 0.01, 0.02, 0.0])


def pictures(kind: type = np.uint8) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [
        cv2.GaussianBlur(rng.integers(0, 256, (48, 64), np.uint8), (0, 0), 1.0).astype(kind) for _ in STAMPS
    ]


class Recording:
    """Writes messages in the given kind of recording."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path, self.kind = path, kind
        if kind == "ros1":
            self.store = get_typestore(Stores.ROS1_NOETIC)
            self.writer: Any = Writer1(path)
        else:
            self.store = get_typestore(Stores.ROS2_HUMBLE)
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.connections: dict[str, Any] = {}

    def write(self, topic: str, name: str, recorded: int, stamp: int, **content: Any) -> None:
        types = self.store.types
        moment = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        more = {"seq": 0} if self.kind == "ros1" else {}
        header = types["std_msgs/msg/Header"](stamp=moment, frame_id="camera", **more)
        message = types[name](header=header, **content)
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        self.writer.write(self.connections[topic], recorded, serialize(message, name))

    def image(
        self, topic: str, image: np.ndarray, stamp: int, encoding: str = "mono8", recorded: int = 0
    ) -> None:
        self.write(
            topic,
            "sensor_msgs/msg/Image",
            recorded or stamp + 5_000_000,
            stamp,
            height=image.shape[0],
            width=image.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=image.strides[0],
            data=np.frombuffer(image.tobytes(), np.uint8),
        )

    def camera_info(self, topic: str, model: str = "plumb_bob", distortion: np.ndarray = BROWN) -> None:
        upper = self.kind == "ros1"
        types = self.store.types
        matrices = {
            "d": distortion,
            "k": np.array([60, 0, 32.5, 0, 61, 24.5, 0, 0, 1.0]),
            "r": np.eye(3).ravel(),
            "p": np.array([55, 0, 31.5, 0, 0, 56, 23.5, 0, 0, 0, 1, 0.0]),
        }
        self.write(
            topic,
            "sensor_msgs/msg/CameraInfo",
            STAMPS[0],
            STAMPS[0],
            height=48,
            width=64,
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
            **{key.upper() if upper else key: value for key, value in matrices.items()},
        )

    def close(self) -> Path:
        self.writer.close()
        return self.path


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_recordings(tmp_path: Path, kind: str) -> None:
    recording = Recording(tmp_path / ("r.bag" if kind == "ros1" else "r"), kind)
    recording.camera_info("/cam0/camera_info")
    for image, stamp in zip(pictures(), STAMPS, strict=True):
        recording.image("/cam0/image_raw", image, stamp)
        recording.image("/cam0/depth", image, stamp)
    path = recording.close()
    sequence = open_sequence(path)
    assert (len(sequence), sequence.size, sequence.name) == (3, (64, 48), "r")
    assert sequence.kind == "ROS bag, /cam0/image_raw"
    assert sequence.timestamps.tolist() == pytest.approx([stamp / 1e9 for stamp in STAMPS], abs=1e-6)
    assert sequence.calibrated is Calibrated.GIVEN
    assert sequence.camera.params.tolist() == [60, 61, 32.5, 24.5, *BROWN]
    for index in (2, 0, 1):
        for each in (sequence, pickle.loads(pickle.dumps(sequence))):
            assert torch.equal(each.image(index)[0, 0] * 255, torch.from_numpy(pictures()[index]).float())
    assert float(open_sequence(path, "f=0.8w").camera.fx) == pytest.approx(51.2)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_the_file_inside_the_folder(tmp_path: Path, kind: str) -> None:
    recording = Recording(tmp_path / "r", kind)
    for image, stamp in zip(pictures(), STAMPS, strict=True):
        recording.image("/image", image, stamp)
    (file,) = (path for path in recording.close().iterdir() if path.suffix in (".db3", ".mcap"))
    sequence = open_sequence(file)
    assert (len(sequence), sequence.calibrated) == (3, Calibrated.MISSING)


def test_several_topics(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "r.bag", "ros1")
    for topic in ("/cam0/image_raw", "/cam1/image_raw"):
        for image, stamp in zip(pictures(), STAMPS, strict=True):
            recording.image(topic, image // (1 + ("1" in topic)), stamp)
    path = recording.close()
    with pytest.raises(
        SequenceError, match=r"2 topics of images; choose one: '.*r\.bag\?topic=/cam0/image_raw' or"
    ):
        open_sequence(path)
    second = open_sequence(f"{path}?topic=/cam1/image_raw")
    assert torch.equal(second.image(0)[0, 0] * 255, torch.from_numpy(pictures()[0] // 2).float())
    with pytest.raises(
        SequenceError, match=r"no images on /cam2; topics of images: /cam0/image_raw, /cam1/image_raw"
    ):
        open_sequence(f"{path}?topic=/cam2")


def test_times_out_of_order_and_missing(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "r.bag", "ros1")
    start = STAMPS[0]
    for number, (image, stamp) in enumerate(zip([*pictures(), pictures()[0]], [2, 1, 3, 3], strict=True)):
        recording.image("/image", image, start + stamp * 10**8, recorded=start + 10**9 + number)
    for number, image in enumerate(pictures()):
        recording.image("/bare", image, 0, recorded=start + number * 10**8)
    path = recording.close()
    sequence = open_sequence(f"{path}?topic=/image")
    assert (sequence.timestamps - start / 1e9).tolist() == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)
    assert sequence.notes == ("left out 1 images whose time repeats",)
    for index, picture in enumerate((1, 0, 2)):
        assert torch.equal(sequence.image(index)[0, 0] * 255, torch.from_numpy(pictures()[picture]).float())
    bare = open_sequence(f"{path}?topic=/bare")
    assert (bare.timestamps - start / 1e9).tolist() == pytest.approx([0, 0.1, 0.2], abs=1e-6)


def test_compressed_and_rectified(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "r.bag", "ros1")
    recording.camera_info("/cam0/camera_info")
    for image, stamp in zip(pictures(), STAMPS, strict=True):
        data = cv2.imencode(".png", image)[1].ravel()
        recording.write(
            "/cam0/image_rect/compressed",
            "sensor_msgs/msg/CompressedImage",
            stamp,
            stamp,
            format="png",
            data=data,
        )
    sequence = open_sequence(recording.close())
    assert sequence.camera.params.tolist() == [55, 56, 31.5, 23.5]
    assert torch.equal(sequence.image(1)[0, 0] * 255, torch.from_numpy(pictures()[1]).float())


def test_twelve_bits_and_a_fisheye(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "r.bag", "ros1")
    recording.camera_info("/camera_info", "equidistant", BROWN[:4])
    for image, stamp in zip(pictures(np.uint16), STAMPS, strict=True):
        recording.image("/image_raw", image * 16 + 15, stamp, "mono16")
    sequence = open_sequence(recording.close())
    assert sequence.camera.model == "fisheye"
    expected = torch.from_numpy((pictures()[0] * np.float32(16) + 15) / 4095)
    torch.testing.assert_close(sequence.image(0)[0, 0], expected)


def test_wrong_recordings(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + b"\x00" * 300)
    (tmp_path / "b.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\x07" * 300)
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "metadata.yaml").write_text("nothing")
    for name in ("a.bag", "b.mcap", "c"):
        with pytest.raises(SequenceError, match=rf"{name}: cannot be read"):
            open_sequence(tmp_path / name)
    recording = Recording(tmp_path / "d.bag", "ros1")
    recording.camera_info("/camera_info")
    with pytest.raises(SequenceError, match="no images on any topic; topics of images: none"):
        open_sequence(recording.close())
    recording = Recording(tmp_path / "e.bag", "ros1")
    recording.camera_info("/camera_info", "thin_prism")
    recording.image("/image", pictures()[0], STAMPS[0])
    path = recording.close()
    with pytest.raises(CalibrationError, match="distortion model `thin_prism` is not known"):
        open_sequence(path)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_calibration_that_is_not_finite_is_refused(tmp_path: Path, kind: str) -> None:
    recording = Recording(tmp_path / ("r.bag" if kind == "ros1" else "r"), kind)
    recording.camera_info("/camera_info", distortion=np.array([0.1, np.nan, 0.0, 0.0, 0.0]))
    recording.image("/image", pictures()[0], STAMPS[0])
    with pytest.raises(CalibrationError, match=r"the parameters must be finite, got \[60.*nan"):
        open_sequence(recording.close())


def test_a_definition_in_the_recording_is_not_followed(tmp_path: Path) -> None:
    """One of an array of 10^8 texts would be code of as many lines."""
    store = get_typestore(Stores.ROS1_NOETIC)
    text, digest = store.generate_msgdef("sensor_msgs/msg/Image")
    for name, changed, own in (("a", "string[100000000] more\n" + text, digest), ("b", text, "0" * 32)):
        recording = Recording(tmp_path / f"{name}.bag", "ros1")
        recording.connections["/image"] = recording.writer.add_connection(
            "/image", "sensor_msgs/msg/Image", msgdef=changed, md5sum=own
        )
        for image, stamp in zip(pictures(), STAMPS, strict=True):
            recording.image("/image", image, stamp)
        recording.close()
    started = time.process_time()
    assert len(open_sequence(tmp_path / "a.bag")) == 3
    assert time.process_time() - started < 5
    with pytest.raises(SequenceError, match=r"b\.bag: .*sensor_msgs/msg/Image with another definition, 000"):
        open_sequence(tmp_path / "b.bag")


class Image:
    """A sensor_msgs/Image."""

    def __init__(self, data: np.ndarray, encoding: str, width: int, step: int, big: int = 0) -> None:
        self.data, self.encoding, self.width, self.step = data.ravel().view(np.uint8), encoding, width, step
        self.height, self.is_bigendian = data.shape[0], big


@pytest.mark.parametrize("encoding", [each for each in COLORS if COLORS[each][0] > 2])
def test_colors(encoding: str) -> None:
    channels = COLORS[encoding][0]
    image = np.zeros((2, 5, channels), np.uint8)  # padded to rows of five pixels
    image[:, :, encoding.find("r") if "r" in encoding else 2] = 100
    gray = to_gray(Image(image, encoding, 4, 5 * channels), "here")
    assert gray.shape == (2, 4)
    assert np.abs(gray - 0.299 * 100).max() <= 1


@pytest.mark.parametrize(("encoding", "luma"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_luma(encoding: str, luma: int) -> None:
    image = np.full((2, 4, 2), 128, np.uint8)
    image[..., luma] = np.arange(8).reshape(2, 4) * 10 + 50
    assert to_gray(Image(image, encoding, 4, 8), "here").tolist() == image[..., luma].tolist()


@pytest.mark.parametrize(
    ("encoding", "place"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))]
)
def test_bayer(encoding: str, place: tuple[int, int]) -> None:
    """Where only red pixels see something, the image is red, of which 0.299 is gray."""
    image = np.zeros((16, 16), np.uint8)
    image[place[0] :: 2, place[1] :: 2] = 200
    gray = to_gray(Image(image, f"bayer_{encoding}8", 16, 16), "here")
    assert float(gray[4:-4, 4:-4].mean()) == pytest.approx(0.299 * 200, abs=1.5)


def test_big_endian_images_are_read() -> None:
    image = (np.arange(8).reshape(2, 4) * 1000).astype(">u2")
    gray = to_gray(Image(image, "mono16", 4, 8, big=1), "here")
    assert gray.dtype == np.uint16
    assert gray.tolist() == image.tolist()


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (Image(np.zeros((2, 8), np.uint8), "32FC1", 2, 8), "encoding `32FC1` is not read"),
        (Image(np.zeros((2, 8), np.uint8), "rgb8", 4, 8), "16 bytes are too few for 4x2 of rgb8"),
        (Image(np.zeros((0, 8), np.uint8), "mono8", 4, 8), "too few"),
    ],
)
def test_wrong_images(message: Image, error: str) -> None:
    with pytest.raises(SequenceError, match=f"here: .*{error}"):
        to_gray(message, "here")
