"""Depth images of a second sensor: 16 bits, or floats in meters, in folders or lists of several datasets.

TUM, ETH3D   `depth.txt`, lines of `timestamp file`, 5000 units per meter:
             https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
ICL-NUIM     `depth/`, 5000 units per meter: https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html
7-Scenes     `frame-000000.depth.png`, millimeters:
             https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/
ScanNet, Open3D, RealSense   a folder of images, millimeters
"""

from __future__ import annotations

import contextlib
import itertools
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped
from torch import Tensor

from torchslam.data.formats.frame_names import MAX_FILES, files_in, in_order, times_in_names
from torchslam.data.formats.image_file import AS_STORED, MAX_BYTES, MAX_PIXELS, read_pixels
from torchslam.data.text_file import check_rising, float64, listed_files, parse_number
from torchslam.errors import FrameError, MeasurementError, SequenceError
from torchslam.utils.files import check_regular

DEPTH_LIST = "depth.txt"
FLOATS = frozenset({".tif", ".tiff", ".npy", ".exr", ".pfm"})
SUFFIXES = FLOATS | {".png", ".pgm"}
"""Of files that can have floats, and of others that can have 16 bits."""
SEVEN_SCENES_DEPTH = "frame-*.depth.png"
BOUNDS_M = 0.05, 200.0
"""Meters that the middle depth of an image may have; beyond, its unit is another one. Sensors see .2 to 20 m, rendered
scenes more."""


@dataclass(frozen=True)
class DepthImages:
    """Files of depth images.

    Attributes:
        source: the list or the folder, for messages.
        paths: of the files, in the order of their names or times.
        timestamps: seconds; None where only the names say to which image each belongs.
        units_per_meter: of their values.
        said: whether the user or the layout of the dataset states the unit.
    """

    source: Path
    paths: tuple[Path, ...]
    timestamps: Float[Tensor, " N"] | None
    units_per_meter: float
    said: bool = True


def parse_depth_folder(text: str) -> tuple[str, float | None]:
    """Read `FOLDER` or `FOLDER:SCALE`, with the units per meter; a folder whose name has a colon is one.

    Raises MeasurementError for another scale than a positive number.
    """
    folder, colon, scale = text.rpartition(":")
    if not colon or Path(text).exists() or not folder or re.search(r"[/\\]", scale):
        return text, None
    where = f"--depth {text}: {scale} is no number of units per meter, such as 1000 for millimeters"
    units = parse_number(scale, where, MeasurementError)
    if units <= 0:
        raise MeasurementError(where)
    return folder, units


def find_depth_images(path: str | Path, units_per_meter: float | None = None) -> DepthImages:
    """The depth images of a list (`depth.txt`), of a folder, or of a dataset whose folder has them.

    Without `units_per_meter`, floats are meters, other values in the unit of the dataset, or millimeters. Raises
    MeasurementError if there are none, or a list is wrong, naming file and line.
    """
    path = Path(path)
    if not path.exists():
        raise MeasurementError(f"{path}: no such folder of depth images")
    listed = [path / DEPTH_LIST, *([path.parent / DEPTH_LIST] if path.name == "depth" else [])]
    found = next((each for each in listed if each.is_file()), None if path.is_dir() else path)
    if found is not None:
        lines = itertools.islice(listed_files(found, MeasurementError), MAX_FILES + 1)
        places, seconds, paths = zip(*lines, strict=True)
        if len(paths) > MAX_FILES:
            raise MeasurementError(f"{found}: more than {MAX_FILES} depth images")
        check_rising(seconds, places, MeasurementError)
        return DepthImages(found, paths, float64(seconds), units_per_meter or _meters(paths[0]) or 5000.0)
    files = _files(path)
    if not files and (path / "depth").is_dir():
        path = path / "depth"
        files = _files(path)
    if not files:
        raise MeasurementError(f"{path}: no depth images: no {DEPTH_LIST}, {', '.join(sorted(SUFFIXES))}")
    is_icl = next(path.parent.glob("*.gt.freiburg"), None) is not None
    units_per_meter = units_per_meter or _meters(files[0])
    is_known = is_icl or files[0].match(SEVEN_SCENES_DEPTH) or units_per_meter is not None
    units = units_per_meter or (5000.0 if is_icl else 1000.0)
    times = times_in_names(files)
    rising = times is not None and all(after > before for before, after in itertools.pairwise(times))
    return DepthImages(path, tuple(files), float64(times) if rising else None, units, is_known)


def _files(folder: Path) -> list[Path]:
    """The depth images in a folder: those of 7-Scenes are beside the color images."""
    try:
        found = [file for file in files_in(folder, SUFFIXES) if not file.name.startswith(".")]
        return in_order([file for file in found if file.match(SEVEN_SCENES_DEPTH)] or found)
    except SequenceError as error:
        raise MeasurementError(str(error)) from None


def _meters(path: Path) -> float | None:
    """1, the units per meter of floats; None for a file of integers, or one that cannot be read."""
    with contextlib.suppress(FrameError):  # said when it is read
        if path.suffix.lower() in FLOATS and _values(path).dtype.kind == "f":
            return 1.0
    return None


def _values(path: Path) -> Shaped[np.ndarray, "H W *channels"]:
    """The values of a file as they are stored. Raises FrameError if it cannot be read."""
    if path.suffix.lower() != ".npy":
        try:
            return read_pixels(path, str(path), flags=AS_STORED)
        except FrameError as cause:
            hint = "depth is read from PNG, TIFF and PGM of 16 bits, and from TIFF, PFM and .npy with floats"
            if path.suffix.lower() == ".exr":
                hint += "; from EXR if OpenCV has it, and OPENCV_IO_ENABLE_OPENEXR=1 is set"
            raise FrameError(f"{cause}; {hint}") from cause
    try:
        check_regular(path, MAX_BYTES, "an array that is read")
        values = np.lib.format.open_memmap(path, mode="r")  # allocates nothing for what a header declares
    except (OSError, ValueError, OverflowError, SyntaxError, TypeError) as cause:
        raise FrameError(f"{path}: not an array of NumPy: {cause}") from cause
    if values.size > MAX_PIXELS:
        raise FrameError(f"{path}: {values.size} values, more than the {MAX_PIXELS} of an image that is read")
    return np.array(values[..., 0] if values.shape[2:] == (1,) else values)


def read_depth(path: Path, units_per_meter: float) -> Float[np.ndarray, "H W"]:
    """Depth along the optical axis in meters, float32; 0 where it was not measured.

    Raises FrameError if the file cannot be read, MeasurementError if it has another type, shape or unit.
    """
    values = _values(path)
    is_whole = values.dtype.kind in "iu" and values.dtype.itemsize > 1
    if not is_whole and values.dtype.kind != "f":
        raise MeasurementError(f"{path}: {values.dtype}, not of 16 bits or floats: no depth image")
    if values.ndim != 2:
        raise MeasurementError(f"{path}: an array {values.shape}, not one depth for each pixel")
    largest = (
        np.iinfo(values.dtype).max if is_whole else 1e4 * units_per_meter
    )  # renderers write more for the sky
    # Like 0, the largest values, NaN and negative ones mark pixels without a measurement.
    depth = np.where((values > 0) & (values < largest), values, 0).astype(np.float32)
    depth /= np.float32(units_per_meter)
    known = depth[depth > 0]
    if known.size and not BOUNDS_M[0] < (middle := float(np.median(known))) < BOUNDS_M[1]:
        raise MeasurementError(
            f"{path}: its middle depth is {middle:.3g} m with {units_per_meter:g} units per meter: give the right "
            "number, as in --depth FOLDER:1000"
        )
    return depth
