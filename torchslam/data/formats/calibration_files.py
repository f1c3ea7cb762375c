"""Calibration files of other programs: OpenCV, ROS, Kalibr, EuRoC, ORB-SLAM3, COLMAP, nerfstudio.

Pixel (0, 0) is the center of the top left pixel, as in OpenCV, ROS, Kalibr and ORB-SLAM3. COLMAP and nerfstudio use its
corner, so their principal points are larger by half a pixel.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchslam.data.calibration import Calibration, Size, read_numbers
from torchslam.data.formats.text_file import numbered_lines, parse_floats, read_text
from torchslam.errors import CalibrationError
from torchslam.geometry.transforms import HALF_PIXEL
from torchslam.utils.files import JSON_BYTES, parse_json

MAX_BYTES = 1 << 18
LARGEST = 1e12  # JSON numbers may have any number of digits
FISHEYES = ("equidistant", "fisheye", "kannala", "opencv_fisheye")
BROWN = ("plumb_bob", "radtan", "radial-tangential", "radial_tangential", "rational_polynomial", "none", "")
MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k")
DISTORTION_KEYS = (
    *("distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients", "D", "d"),
)
WIDTH_KEYS, HEIGHT_KEYS = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")

# COLMAP, src/colmap/sensor/models.h: where each parameter goes among fx fy cx cy and the distortion.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ("f cx cy", "pinhole"),
    "PINHOLE": ("fx fy cx cy", "pinhole"),
    "SIMPLE_RADIAL": ("f cx cy k1", "radial_tangential"),
    "RADIAL": ("f cx cy k1 k2", "radial_tangential"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "radial_tangential"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "radial_tangential"),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", "fisheye"),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", "fisheye"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "fisheye"),
}
COLMAP_LINE = re.compile(r"\d+\s+[A-Z_]+\s+\d{1,9}\s+\d{1,9}\s", re.ASCII)


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file, recognized by its content.

    Supported are a line of numbers (`parse_numbers`, optionally with a `distortion.txt` next to it), OpenCV's YAML
    and XML, ROS camera_info, Kalibr's camchain, EuRoC's sensor.yaml, ORB-SLAM3's settings, COLMAP's cameras.txt and
    nerfstudio's transforms.json.

    Raises CalibrationError naming the file.
    """
    path = Path(path)
    # A transforms.json has all frames in it.
    text = read_text(path, CalibrationError, JSON_BYTES if path.suffix.lower() == ".json" else MAX_BYTES)
    start = text.lstrip()
    if start.startswith("{"):
        return _from_transforms(path, text)
    if start.startswith("<"):
        return _from_xml(path, text)
    if path.suffix.lower() in (".yaml", ".yml") or start.startswith("%YAML"):
        return _from_yaml(path, text)
    lines = [line for _, line in numbered_lines(path, CalibrationError)]
    if lines and COLMAP_LINE.match(lines[0]):
        return from_colmap(path, lines)
    return read_numbers(path)


def checked(
    intrinsics: list[float],
    coefficients: list[float],
    source: str,
    distortion: str = "",
    size: Size | None = None,
) -> Calibration:
    """A calibration with a distortion model by one of its many names.

    Args:
        intrinsics: fx fy cx cy.

    Raises:
        CalibrationError: for models and coefficients that torchslam does not have.
    """
    name = distortion.lower()
    if name in FISHEYES:
        if len(coefficients) != 4:
            raise CalibrationError(f"{source}: a fisheye has 4 coefficients, not {len(coefficients)}")
        return Calibration.from_numbers([*intrinsics, *coefficients], source, "fisheye", size)
    if name not in BROWN:
        raise CalibrationError(
            f"{source}: distortion model `{distortion}` is not known; there are "
            f"{', '.join(word for word in (*BROWN, *FISHEYES) if word)}"
        )
    if any(coefficients[5:]):
        raise CalibrationError(
            f"{source}: more than k1 k2 p1 p2 k3 is not modeled; calibrate with these alone"
        )
    if coefficients:
        coefficients = [*coefficients, 0.0, 0.0, 0.0, 0.0][: max(4, min(5, len(coefficients)))]
    return Calibration.from_numbers([*intrinsics, *coefficients], source, size=size)


def _from_yaml(path: Path, text: str) -> Calibration:
    for prefix in ("Camera1.", "Camera."):
        if yaml_value(text, f"{prefix}fx") is not None:
            return _from_orb_slam(path, text, prefix)
    intrinsics = yaml_numbers(text, ("intrinsics",), str(path))
    if intrinsics is not None:
        return _from_kalibr(path, text, intrinsics)
    matrix = yaml_numbers(text, MATRIX_KEYS, str(path))
    if matrix is None:
        raise CalibrationError(
            f"{path}: no camera in it; looked for camera_matrix (OpenCV, ROS), intrinsics (Kalibr, EuRoC) "
            "and Camera.fx (ORB-SLAM3)"
        )
    size = _size(yaml_numbers(text, WIDTH_KEYS, str(path)), yaml_numbers(text, HEIGHT_KEYS, str(path)))
    model = yaml_value(text, "distortion_model") or yaml_value(text, "camera_model") or ""
    return _from_matrix(
        path,
        matrix,
        yaml_numbers(text, DISTORTION_KEYS, str(path)) or [],
        model if "pinhole" not in model else "",
        size,
    )


def _from_xml(path: Path, text: str) -> Calibration:
    """OpenCV's FileStorage as XML."""
    if "<!ENTITY" in text:
        raise CalibrationError(f"{path}: entities are not read")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as cause:
        raise CalibrationError(f"{path}: not valid XML: {cause}") from cause

    def numbers(keys: tuple[str, ...]) -> list[float] | None:
        for key in keys:
            element = root.find(f".//{key}")
            if element is not None:
                return parse_floats(
                    element.findtext("data") or element.text or "", str(path), CalibrationError
                )
        return None

    matrix = numbers(MATRIX_KEYS)
    if matrix is None:
        raise CalibrationError(f"{path}: no camera_matrix in it")
    return _from_matrix(
        path, matrix, numbers(DISTORTION_KEYS) or [], "", _size(numbers(WIDTH_KEYS), numbers(HEIGHT_KEYS))
    )


def _from_matrix(
    path: Path, matrix: list[float], coefficients: list[float], distortion: str, size: Size | None
) -> Calibration:
    if len(matrix) != 9:
        raise CalibrationError(f"{path}: a camera matrix has 9 numbers, not {len(matrix)}")
    return checked([matrix[0], matrix[4], matrix[2], matrix[5]], coefficients, str(path), distortion, size)


def _from_kalibr(path: Path, text: str, intrinsics: list[float]) -> Calibration:
    """The first camera of a camchain, or EuRoC's sensor.yaml."""
    coefficients = yaml_numbers(text, ("distortion_coeffs", "distortion_coefficients"), str(path)) or []
    resolution = yaml_numbers(text, ("resolution",), str(path))
    model = yaml_value(text, "camera_model") or "pinhole"
    if model != "pinhole" or len(intrinsics) != 4:
        raise CalibrationError(f"{path}: camera model `{model}` is not known; there is pinhole")
    size = None if resolution is None else _size(resolution[:1], resolution[1:])
    return checked(intrinsics, coefficients, str(path), yaml_value(text, "distortion_model") or "", size)


def _from_orb_slam(path: Path, text: str, prefix: str) -> Calibration:
    def number(key: str) -> float | None:
        found = yaml_numbers(text, (key,), str(path))
        return found[0] if found else None

    intrinsics = [number(prefix + key) for key in ("fx", "fy", "cx", "cy")]
    if None in intrinsics:
        raise CalibrationError(f"{path}: {prefix}fx, fy, cx and cy are needed")
    fisheye = (yaml_value(text, "Camera.type") or "").lower().startswith("kannala")
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    coefficients = [number(prefix + key) or 0.0 for key in keys]
    width, height = number("Camera.width"), number("Camera.height")
    size = _size([width] if width else None, [height] if height else None)
    known = [value for value in intrinsics if value is not None]
    return checked(known, coefficients, str(path), "fisheye" if fisheye else "", size)


def from_colmap(path: Path, lines: list[str]) -> Calibration:
    """The single camera of a cameras.txt: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`."""
    if len(lines) != 1:
        raise CalibrationError(f"{path}: {len(lines)} cameras; a file with the one to be used is needed")
    _, model, width, height, *words = lines[0].split()
    if model not in COLMAP_MODELS:
        raise CalibrationError(
            f"{path}: camera model {model} is not known; there are {', '.join(COLMAP_MODELS)}"
        )
    keys, kind = COLMAP_MODELS[model][0].split(), COLMAP_MODELS[model][1]
    numbers = parse_floats(" ".join(words), str(path), CalibrationError)
    if len(numbers) != len(keys):
        raise CalibrationError(f"{path}: {model} has the parameters {' '.join(keys)}, got {len(numbers)}")
    values = dict(zip(keys, numbers, strict=True))
    return _from_corner(values, kind == "fisheye", str(path), (int(width), int(height)))


def _from_transforms(path: Path, text: str) -> Calibration:
    """The camera that all frames of a transforms.json share."""
    try:
        content: Any = parse_json(text)
    except ValueError as cause:
        raise CalibrationError(f"{path}: not valid JSON: {cause}") from cause
    numbers = {key: value for key, value in content.items() if isinstance(value, int | float)}
    if not all(abs(value) < LARGEST for value in numbers.values()):  # not so NaN either
        raise CalibrationError(f"{path}: a number in it is not finite")
    numeric = {key: float(value) for key, value in numbers.items()}
    width, height = numeric.get("w"), numeric.get("h")
    size = _size([width] if width else None, [height] if height else None)
    focal = numeric.get("fl_x")
    if focal is None and width and "camera_angle_x" in numeric:
        focal = (
            0.5 * width / math.tan(0.5 * numeric["camera_angle_x"]) if numeric["camera_angle_x"] > 0 else 0.0
        )
    if focal is None:
        raise CalibrationError(f"{path}: no fl_x in it that holds for all frames")
    values = {key: numeric.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4")}
    values |= {"fx": focal, "fy": numeric.get("fl_y", focal)}
    for key, extent in (("cx", width), ("cy", height)):
        if key not in numeric and extent is None:
            raise CalibrationError(f"{path}: no {key} in it, nor the size of the images")
        values[key] = numeric.get(key, (extent or 0.0) / 2)
    return _from_corner(
        values, str(content.get("camera_model", "")).upper() == "OPENCV_FISHEYE", str(path), size
    )


def _from_corner(values: dict[str, float], fisheye: bool, source: str, size: Size | None) -> Calibration:
    """A camera of COLMAP, or of what builds on it: pixels count from the corner of the top left one, as stored."""
    fx, fy = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
    intrinsics = [fx, fy, values["cx"] - HALF_PIXEL, values["cy"] - HALF_PIXEL]
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients, model = [values.get(key, 0.0) for key in keys], "fisheye" if fisheye else ""
    return replace(checked(intrinsics, coefficients, source, model, size), as_stored=True)


def _size(width: list[float] | None, height: list[float] | None) -> Size | None:
    return (int(width[0]), int(height[0])) if width and height and min(width[0], height[0]) >= 1 else None


def yaml_value(text: str, key: str) -> str | None:
    """Return the text after the first `key:`, of a matrix its `data`; None if the key is missing."""
    found = re.search(rf"^([ \t]*(?:- )?){re.escape(key)}[ \t]*:", text, re.MULTILINE)
    if found is None:
        return None
    rest = text[found.end() :]
    line, _, below = rest.partition("\n")
    line = re.split(r"(?:^|\s)#", line, maxsplit=1)[0].strip()
    if line.startswith("["):
        return _bracketed(rest.lstrip(" \t"))
    if line and not line.startswith("!!"):
        return line.strip("\"'")
    block = _block(below, len(found[1]))
    data = yaml_value(block, "data")
    return (
        " ".join(re.findall(r"^[ \t]*-[ \t]*([^\s:]+)[ \t]*$", block, re.MULTILINE)) if data is None else data
    )


def yaml_numbers(text: str, keys: tuple[str, ...], where: str) -> list[float] | None:
    """The numbers of the first of the keys that is there. Raises CalibrationError at `where` for anything else."""
    for key in keys:
        value = yaml_value(text, key)
        if value is not None:
            return parse_floats(value, f"{where}: {key}", CalibrationError)
    return None


def _bracketed(text: str) -> str:
    """Return the words of a (nested) bracketed list, which may span lines."""
    depth, words = 0, []
    for part in re.findall(r"\[|\]|#[^\n]*|[^\[\]#]+", text):
        depth += (part == "[") - (part == "]")
        if depth == 0:
            break
        if part not in "[]" and not part.startswith("#"):
            words.append(part)
    return " ".join(words)


def _block(text: str, indent: int) -> str:
    """The lines up to one that is not further in than `indent`; dashes may stand where their key does."""
    lines = []
    for line in text.splitlines():
        inner = len(line) - len(line.lstrip())
        if line.strip() and (inner < indent or (inner == indent and not line.lstrip().startswith("-"))):
            break
        lines.append(line)
    return "\n".join(lines)
