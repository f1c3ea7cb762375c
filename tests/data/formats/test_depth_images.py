"""Depth images in the layouts of datasets."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.fuzz import valid_inputs
from tests.fuzz.valid_inputs import place
from torchslam.data import open_sequence
from torchslam.data.formats.depth_images import find_depth_images, parse_depth_folder, read_depth
from torchslam.errors import FrameError, MeasurementError


def write(path: Path, values: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values)
    return path


def test_values_without_depth_are_zero(tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", np.array([[0, 65535], [1000, 2500]], np.uint16))
    assert read_depth(path, 1000.0).tolist() == [[0, 0], [1, 2.5]]
    assert not read_depth(write(tmp_path / "b.png", np.zeros((2, 2), np.uint16)), 1000.0).any()


def test_images_of_8_bits_and_another_unit_are_errors(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match="not of 16 bits"):
        read_depth(write(tmp_path / "a.png", np.full((4, 4), 9, np.uint8)), 1000.0)
    path = write(tmp_path / "b.png", np.full((4, 4), 2000, np.uint16))
    with pytest.raises(MeasurementError, match=r"its middle depth is 2e[+]03 m with 1 units per meter"):
        read_depth(path, 1.0)


def test_layouts_of_datasets(tmp_path: Path) -> None:
    listed = find_depth_images(place(tmp_path / "tum", valid_inputs.depth_images()))
    assert listed.timestamps is not None
    assert (listed.units_per_meter, listed.timestamps.tolist()) == (5000.0, [1000.0, 1000.1, 1000.2])
    assert find_depth_images(tmp_path / "tum" / "depth").source == tmp_path / "tum" / "depth.txt"
    scenes = place(tmp_path / "seq-01", valid_inputs.seven_scenes())
    write(scenes / "frame-000001.depth.png", np.full((4, 4), 2000, np.uint16))
    found = find_depth_images(scenes)
    assert [path.name for path in found.paths] == ["frame-000001.depth.png"]
    assert (found.units_per_meter, found.said, found.timestamps) == (1000.0, True, None)
    icl = place(tmp_path / "icl", valid_inputs.icl_nuim())
    write(icl / "depth" / "10.png", np.full((4, 4), 2000, np.uint16))
    write(icl / "depth" / "2.png", np.full((4, 4), 2000, np.uint16))
    found = find_depth_images(icl / "depth")
    assert [path.name for path in found.paths] == ["2.png", "10.png"]
    assert (found.units_per_meter, found.said) == (5000.0, True)
    other = write(tmp_path / "scan" / "depth" / "0.5.png", np.full((4, 4), 2000, np.uint16))
    write(tmp_path / "scan" / "depth" / "1.5.png", np.full((4, 4), 2000, np.uint16))
    found = find_depth_images(other.parent.parent)
    assert found.timestamps is not None
    assert (found.units_per_meter, found.said, found.timestamps.tolist()) == (1000.0, False, [0.5, 1.5])


def test_datasets_bring_their_depth_images(tmp_path: Path) -> None:
    tum = place(tmp_path / "tum", valid_inputs.tum())
    assert open_sequence(tum).measurements == {}
    place(tum, valid_inputs.depth_images())
    assert open_sequence(tum).measurements == {"depth": str(tum / "depth.txt")}
    scenes = place(tmp_path / "seq-01", valid_inputs.seven_scenes())
    write(scenes / "frame-000001.depth.png", np.full((4, 4), 2000, np.uint16))
    brought = open_sequence(scenes, "60,60,31.5,23.5").measurements
    assert brought == {"depth": str(scenes), "depth_camera": "585,585,320,240"}
    icl = place(tmp_path / "icl", valid_inputs.icl_nuim())
    write(icl / "depth" / "10.png", np.full((4, 4), 2000, np.uint16))
    assert open_sequence(icl, "60,60,31.5,23.5").measurements == {"depth": str(icl / "depth")}


def test_a_scale_after_a_colon(tmp_path: Path) -> None:
    assert parse_depth_folder("a/depth:5000") == ("a/depth", 5000.0)
    assert parse_depth_folder("a/depth") == ("a/depth", None)
    assert parse_depth_folder("C:\\depth") == ("C:\\depth", None)
    (tmp_path / "at:3").mkdir()
    assert parse_depth_folder(str(tmp_path / "at:3")) == (str(tmp_path / "at:3"), None)
    for wrong in ("a:b", "a:0", "a:-1", "a:nan", "a:inf"):
        with pytest.raises(MeasurementError, match="is no number of units per meter"):
            parse_depth_folder(wrong)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no files are listed"),
        ("1.0\n", "expected `timestamp file`"),
        ("x depth/0.png\n", "`x` is not a number"),
        ("1 a.png\n1 b.png\n", ":2: "),
    ],
)
def test_wrong_lists_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "depth.txt").write_text(text)
    with pytest.raises(MeasurementError, match=message):
        find_depth_images(tmp_path)


def test_nothing_there(tmp_path: Path) -> None:
    for path, message in ((tmp_path / "none", "no such folder"), (tmp_path, "no depth images")):
        with pytest.raises(MeasurementError, match=message):
            find_depth_images(path)


@pytest.mark.parametrize("name", ["a.tif", "a.pfm", "a.npy"])
def test_floats_are_meters(tmp_path: Path, name: str) -> None:
    """Unless the user states another unit; what is not a depth is zero."""
    values = np.array([[0.0, -1.0, np.nan, np.inf], [1e10, 2.5, 2.5, 3.0]], np.float32)
    np.save(tmp_path / name, values) if name.endswith(".npy") else write(tmp_path / name, values)
    found = find_depth_images(tmp_path)
    assert (found.units_per_meter, found.said) == (1.0, True)
    assert read_depth(tmp_path / name, 1.0).tolist() == [[0, 0, 0, 0], [0, 2.5, 2.5, 3]]
    assert find_depth_images(tmp_path, 1000.0).units_per_meter == 1000.0
    with pytest.raises(MeasurementError, match=r"its middle depth is 0.0025 m with 1000 units"):
        read_depth(tmp_path / name, 1000.0)


@pytest.mark.parametrize("kind", [np.uint16, np.int32])
def test_arrays_of_integers_have_units(tmp_path: Path, kind: type) -> None:
    np.save(tmp_path / "a.npy", np.array([[0, 2500, np.iinfo(kind).max]], kind)[..., None])
    found = find_depth_images(tmp_path)
    assert (found.units_per_meter, found.said) == (1000.0, False)
    assert read_depth(tmp_path / "a.npy", 1000.0).tolist() == [[0, 2.5, 0]]


def test_files_that_have_no_depth(tmp_path: Path) -> None:
    for name, content in {"a.npy": b"\x93NUMPY", "b.npy": b"x", "c.exr": b"v/1\x01" + bytes(99)}.items():
        (tmp_path / name).write_bytes(content)
        words = "not an array of NumPy" if name != "c.exr" else "OPENCV_IO_ENABLE_OPENEXR"
        with pytest.raises(FrameError, match=words):
            read_depth(tmp_path / name, 1.0)
    np.save(tmp_path / "d.npy", np.ones((2, 3, 4)))
    np.save(tmp_path / "e.npy", np.ones((2, 3), bool))
    with pytest.raises(MeasurementError, match="not one depth for each pixel"):
        read_depth(tmp_path / "d.npy", 1.0)
    with pytest.raises(MeasurementError, match="bool, not of 16 bits or floats"):
        read_depth(tmp_path / "e.npy", 1.0)
