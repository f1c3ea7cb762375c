"""Calibration files of other programs: OpenCV, ROS, Kalibr, EuRoC, ORB-SLAM3, VINS, COLMAP, nerfstudio.

Pixel (0, 0) is the center of the top left pixel, as in OpenCV, ROS, Kalibr and ORB-SLAM3. COLMAP and nerfstudio use its
corner, so their principal points are larger by half a pixel.

A key that names a model or a distortion, and is not understood, is an error: without it, the camera is a wrong one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchslam.data.calibration import Calibration, Size, read_numbers
from torchslam.data.formats.key_files import MAX_DEPTH, Tree, merged, read_tree
from torchslam.data.text_file import numbered_lines, parse_floats, read_text
from torchslam.errors import CalibrationError
from torchslam.geometry.distortion import MODELS
from torchslam.geometry.transforms import HALF_PIXEL
from torchslam.utils.files import JSON_BYTES

MAX_BYTES = 1 << 18
"""Largest file that is read; those of calibration programs have kilobytes."""
LARGEST = 1e12  # JSON numbers may have any number of digits
FISHEYES = (
    *("equidistant", "fisheye", "opencv_fisheye"),
    *("kannala", "kannala_brandt", "kannalabrandt", "kannalabrandt8"),
)
BROWN = (
    *("plumb_bob", "radtan", "radial-tangential", "radial_tangential", "rational_polynomial"),
    *("brown_conrady", "none", ""),
)
PINHOLES = (
    *("pinhole", "perspective", "rectified", "opencv", "simple_pinhole", "simple_radial", "radial"),
    "full_opencv",
)
"""Names of camera models that leave the distortion to its own key, or to the coefficients."""

# Keys in lower case, without anything but letters and digits.
MATRIX = ("cameramatrix", "intrinsicmatrix", "k", "mtx")
DISTORTION = (
    *("distortioncoefficients", "distortioncoeffs", "distortioncoeff", "distortionparameters", "distortion"),
    *("distcoefficients", "distcoeffs", "distcoeff", "distcoefs", "distcoef", "dist", "coeffs", "d"),
)
WIDTH, HEIGHT = ("imagewidth", "width", "w", "cols"), ("imageheight", "height", "h", "rows")
SIZE = ("resolution", "imagesize")
DISTORTION_MODEL = ("distortionmodel", "distortiontype")
CAMERA_MODEL = ("cameramodel", "modeltype", "cameratype", "projectionmodel")
IS_FISHEYE = ("fisheyemodel", "isfisheye", "usefisheye", "fisheye")
FX, FY, CX, CY = ("fx", "fu"), ("fy", "fv"), ("cx", "cu", "ppx"), ("cy", "cv", "ppy")
OF_A_CAMERA = (
    *("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "is_fisheye"),
)
"""Keys of a transforms.json that a frame may have, too."""
LOOKS_LIKE_DISTORTION = re.compile(r"dist(?!an)|coef|fisheye|^(camera1?)?(k[1-9]|p[1-9])$|^xi$")
"""Of keys that were not used."""
NOTHING = ("", "none", "null", "~")

# COLMAP, src/colmap/sensor/models.h: where each parameter goes among fx fy cx cy and the distortion, of a fisheye where
# the name ends so.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}
COLMAP_LINE = re.compile(r"\d+\s+[A-Z][A-Z_0-9]+\s+\d{1,9}\s+\d{1,9}\s", re.ASCII)


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file, recognized by its content.

    Supported are a line of numbers (`parse_numbers`, optionally with a `distortion.txt` next to it), OpenCV's YAML
    and XML, the same keys in JSON and in YAML of other programs, ROS camera_info, Kalibr's camchain, EuRoC's
    sensor.yaml, ORB-SLAM3's and stella_vslam's settings, VINS' cameras, COLMAP's cameras.txt and nerfstudio's
    transforms.json.

    Raises CalibrationError naming the file.
    """
    path = Path(path)
    # A transforms.json has all frames in it.
    text = read_text(path, CalibrationError, JSON_BYTES if path.suffix.lower() == ".json" else MAX_BYTES)
    tree = _tree(path, text)
    if tree is not None:
        return _from_tree(path, tree)
    lines = [line for _, line in numbered_lines(path, CalibrationError)]
    if lines and COLMAP_LINE.match(lines[0]):
        return from_colmap(path, lines)
    return read_numbers(path)


def read_matrix(path: Path, key: str, count: int) -> list[float]:
    """Read the numbers of a matrix in a file of keys. Raises CalibrationError for another number of them."""
    keys = Keys(_tree(path, read_text(path, CalibrationError, MAX_BYTES)) or {}, str(path))
    numbers = keys.numbers(_normal(key)) or []
    if len(numbers) != count:
        raise CalibrationError(f"{path}: {key}: expected {count} numbers, got {len(numbers)}")
    return numbers


def read_keys(path: Path) -> Iterator[Keys]:
    """The keys of each mapping in a file, from the outermost one inward. Raises CalibrationError if there are none."""
    tree = _tree(path, read_text(path, CalibrationError, MAX_BYTES))
    if not tree:
        raise CalibrationError(f"{path}: no keys in it; a YAML, XML or JSON file is needed")
    for chain in _mappings(tree):
        yield Keys(chain[-1], str(path))


def _tree(path: Path, text: str) -> Tree | None:
    try:
        return read_tree(text, path.suffix)
    except ValueError as cause:
        raise CalibrationError(
            f"{path}: {'not valid JSON: ' * text.lstrip().startswith('{')}{cause}"
        ) from cause


class Keys:
    """The keys of one camera, which are found in any case and with any punctuation."""

    def __init__(self, tree: Tree, source: str) -> None:
        self._values: dict[str, tuple[str, Any]] = {}
        for key, value in tree.items():
            self._values.setdefault(_normal(key), (key, value))
        self._source = source
        self._used: set[str] = set()

    def __contains__(self, keys: tuple[str, ...]) -> bool:
        return any(key in self._values for key in keys)

    def value(self, *keys: str) -> tuple[str, Any] | None:
        """The first of the keys that is there, as it is written, with its value."""
        for key in keys:
            if key in self._values:
                self._used.add(key)
                return self._values[key]
        return None

    def words(self, keys: tuple[str, ...]) -> Iterator[tuple[str, str]]:
        """Those of the keys whose value is text, with that in lower case."""
        for key in keys:
            found = self.value(key)
            if found is not None and isinstance(found[1], str):
                yield found[0], found[1].strip().lower()

    def numbers(self, *keys: str) -> list[float] | None:
        """The numbers of the first of the keys that is there. Raises CalibrationError for anything else."""
        found = self.value(*keys)
        return None if found is None else _numbers(found[1], f"{self._source}: {found[0]}")

    def number(self, *keys: str) -> float | None:
        """The one number of a key. Raises CalibrationError for anything else."""
        numbers = self.numbers(*keys)
        return numbers[0] if numbers else None

    def size(self, *prefixes: str) -> Size | None:
        """The size of the images, if it is there; zeros stand for an unknown one, as in ROS.

        Raises CalibrationError if only one side is there, or not positive.
        """
        both = self.numbers(*SIZE) or []
        sides = [
            self.number(*(prefix + key for prefix in prefixes or ("",) for key in keys))
            for keys in (WIDTH, HEIGHT)
        ]
        width, height = both if len(both) == 2 else (side or 0.0 for side in sides)
        if width == height == 0:
            return None
        if min(width, height) < 1:
            raise CalibrationError(
                f"{self._source}: the size of the images must be positive, got {width:g}x{height:g}"
            )
        return int(width), int(height)

    def check_unused(self) -> None:
        """Raise CalibrationError for a key that looks like distortion and was not used."""
        for key, (written, value) in self._values.items():
            if key in self._used or not LOOKS_LIKE_DISTORTION.search(key) or _is_nothing(value):
                continue
            raise CalibrationError(
                f"{self._source}: `{written}` looks like a distortion, but is not understood; "
                "call it distortion_coefficients, k1 k2 p1 p2 [k3 [k4 k5 k6]], or remove it"
            )


def _normal(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", str(key).lower())


def _is_nothing(value: Any) -> bool:
    """True for no value, and for zeros."""
    try:
        return not any(_numbers(value, ""))
    except CalibrationError:
        return False


def _numbers(value: Any, where: str, depth: int = 0) -> list[float]:
    """The numbers of text, of lists in lists, or of a matrix's `data`."""
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    if isinstance(value, list) and depth < MAX_DEPTH:
        return [number for item in value for number in _numbers(item, where, depth + 1)]
    if value is None or (isinstance(value, str) and value.lower() in NOTHING):
        return []
    if isinstance(value, bool | dict | list):
        raise CalibrationError(f"{where}: expected numbers, got {str(value)[:40]}")
    if isinstance(value, int | float):
        if not abs(value) < LARGEST:  # not so NaN either
            raise CalibrationError(f"{where}: {str(value)[:40]} is not finite")
        return [float(value)]
    return parse_floats(value, where, CalibrationError)


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
    if _is_fisheye(distortion, "distortion", source):
        if len(coefficients) < 4 or any(coefficients[4:]):
            raise CalibrationError(f"{source}: a fisheye has 4 coefficients, not {len(coefficients)}")
        return Calibration.from_numbers([*intrinsics, *coefficients[:4]], source, "fisheye", size)
    if any(coefficients[8:]) or (any(coefficients[5:]) and len(coefficients) < 8):
        raise CalibrationError(
            f"{source}: of {len(coefficients)} distortion coefficients more than k1 k2 p1 p2 [k3 [k4 k5 k6]] is not "
            "modeled; calibrate with these alone"
        )
    if any(coefficients[5:]):
        coefficients = coefficients[:8]
    elif coefficients:
        coefficients = [*coefficients, 0.0, 0.0, 0.0, 0.0][: max(4, min(5, len(coefficients)))]
    return Calibration.from_numbers([*intrinsics, *coefficients], source, size=size)


def _is_fisheye(name: str, of: str, source: str) -> bool:
    """Whether a model is a fisheye, by its name; it is of a "distortion" or a "camera".

    Raises CalibrationError for the name of another model.
    """
    word = re.sub(r"\s+", "_", name.strip().lower())
    known = BROWN if of == "distortion" else (*PINHOLES, *BROWN)
    if word in FISHEYES:
        return True
    if word not in known:
        shown = ", ".join(word for word in (*known, *FISHEYES) if word)
        raise CalibrationError(f"{source}: {of} model `{name}` is not known; there are {shown}")
    return False


def _from_tree(path: Path, tree: Tree) -> Calibration:
    """The first camera of a file of keys; keys above it hold for it, too."""
    source = str(path)
    for chain in _mappings({**tree, **_nested_camera(tree)}):
        keys = Keys({key: value for each in reversed(chain) for key, value in each.items()}, source)
        here = Keys(chain[-1], source)
        for prefix in ("camera1", "camera"):
            if (f"{prefix}fx",) in here:
                return _finished(keys, _from_orb_slam(keys, prefix, source))
        if ("flx", "cameraanglex") in here:
            return _finished(keys, _from_transforms(keys, source))
        if ("intrinsics",) in here:
            return _finished(keys, _from_intrinsics(keys, source))
        if MATRIX in here and len(here.numbers(*MATRIX) or []) != 1:
            return _finished(keys, _from_matrix(keys, source))
        if all(names in here for names in (FX, FY, CX, CY)):
            intrinsics = [keys.number(*names) or 0.0 for names in (FX, FY, CX, CY)]
            return _finished(keys, _with_distortion(keys, intrinsics, source, ("model",)))
    for _, name in Keys(tree, source).words(CAMERA_MODEL):
        _is_fisheye(name, "camera", source)
    raise CalibrationError(
        f"{path}: no camera in it; looked for camera_matrix (OpenCV, ROS), intrinsics (Kalibr, EuRoC), "
        "Camera.fx (ORB-SLAM3), fl_x for all frames (nerfstudio), and fx fy cx cy"
    )


def _finished(keys: Keys, calibration: Calibration) -> Calibration:
    keys.check_unused()
    return calibration


def _nested_camera(tree: Tree) -> Tree:
    """The keys below `Camera:`, as stella_vslam writes them, as `Camera.fx`, as ORB-SLAM3 does."""
    found: Tree = {}
    for name in ("Camera", "Camera1"):
        inner = tree.get(name)
        if isinstance(inner, dict):
            found |= {f"{name}.{key}": value for key, value in inner.items()}
    return found


def _mappings(tree: Tree, above: tuple[Tree, ...] = ()) -> Iterator[tuple[Tree, ...]]:
    """Every mapping, with those that it is in, in the order of the file."""
    chain = (*above, tree)
    yield chain
    for value in tree.values():
        if isinstance(value, dict) and len(chain) < MAX_DEPTH:
            yield from _mappings(value, chain)


def _with_distortion(
    keys: Keys,
    intrinsics: list[float],
    source: str,
    model_keys: tuple[str, ...] = (),
    prefix: str = "",
    size: Size | None = None,
) -> Calibration:
    """A camera with the model and the coefficients that its keys name.

    Args:
        intrinsics: fx fy cx cy.
        model_keys: further keys of the camera's model.
        prefix: of the keys of single coefficients.
        size: of the images; None: as the keys say.
    """
    flags = [_flag(keys, key) for key in IS_FISHEYE]  # all of them, which are used then
    fisheye = any(flags)
    for of, names in (("camera", (*CAMERA_MODEL, *model_keys)), ("distortion", DISTORTION_MODEL)):
        for _, name in keys.words(names):
            fisheye |= _is_fisheye(name, of, source)
    if keys.number("xi"):
        raise CalibrationError(f"{source}: camera model `omnidirectional` (xi) is not known")
    coefficients = _coefficients(keys, fisheye, prefix, source)
    return checked(intrinsics, coefficients, source, "fisheye" if fisheye else "", size or keys.size())


def _flag(keys: Keys, key: str) -> bool:
    """A key that is true or a number other than 0."""
    found = keys.value(key)
    if found is None:
        return False
    return str(found[1]).strip().lower() not in (*NOTHING, "0", "0.0", "0.", "false", "no", "off")


def _coefficients(keys: Keys, fisheye: bool, prefix: str, source: str) -> list[float]:
    """In OpenCV's order: of one list, or of keys of their own."""
    found = keys.value(*DISTORTION)
    names = MODELS["fisheye" if fisheye else "rational"].coefficients
    if found is None:
        return _single_coefficients(keys, names, prefix)
    name, value = found[0], _value(keys, *DISTORTION)
    if isinstance(value, dict) and "data" not in value:
        inner = Keys(value, f"{source}: {name}")
        coefficients = _single_coefficients(inner, names, "")
        if not coefficients:
            raise CalibrationError(
                f"{source}: {name}: expected k1 k2 p1 p2 [k3], got {', '.join(value)[:80]}"
            )
        inner.check_unused()
        return coefficients
    return _numbers(value, f"{source}: {name}")


def _value(keys: Keys, *names: str) -> Any:
    """A value; a list of mappings as one of them."""
    found = keys.value(*names)
    value = None if found is None else found[1]
    return merged(value) if isinstance(value, list) else value


def _single_coefficients(keys: Keys, names: tuple[str, ...], prefix: str) -> list[float]:
    values = [keys.number(prefix + name) for name in names]
    return [] if all(value is None for value in values) else [value or 0.0 for value in values]


def _from_matrix(keys: Keys, source: str) -> Calibration:
    matrix = keys.numbers(*MATRIX) or []
    if len(matrix) != 9:
        raise CalibrationError(f"{source}: a camera matrix has 9 numbers, not {len(matrix)}")
    fx, skew, cx, zero, fy, cy, *last = matrix
    if [zero, *last] != [0, 0, 0, 1]:
        raise CalibrationError(f"{source}: a camera matrix is fx 0 cx, 0 fy cy, 0 0 1, not {matrix}")
    if skew:
        raise CalibrationError(f"{source}: a skew of {skew:g} is not modeled; calibrate without it")
    return _with_distortion(keys, [fx, fy, cx, cy], source)


def _from_intrinsics(keys: Keys, source: str) -> Calibration:
    """The first camera of Kalibr's camchain, or EuRoC's sensor.yaml."""
    value = _value(keys, "intrinsics")
    for _, name in keys.words(CAMERA_MODEL):
        _is_fisheye(name, "camera", source)
    if isinstance(value, dict) and "data" not in value:
        inner = Keys(value, f"{source}: intrinsics")
        numbers = [number for names in (FX, FY, CX, CY) if (number := inner.number(*names)) is not None]
    else:
        numbers = _numbers(value, f"{source}: intrinsics")
    if len(numbers) != 4:
        raise CalibrationError(
            f"{source}: expected `intrinsics: [fx, fy, cx, cy]`, got {len(numbers)} numbers"
        )
    return _with_distortion(keys, numbers, source)


def _from_orb_slam(keys: Keys, prefix: str, source: str) -> Calibration:
    """ORB-SLAM2's, ORB-SLAM3's and stella_vslam's settings."""
    values = [keys.number(prefix + key) for key in ("fx", "fy", "cx", "cy")]
    intrinsics = [value for value in values if value is not None]
    if len(intrinsics) != 4:
        raise CalibrationError(f"{source}: {prefix}.fx, fy, cx and cy are needed")
    size = keys.size("camera", prefix)
    return _with_distortion(keys, intrinsics, source, prefix=prefix, size=size)


def from_colmap(path: Path, lines: list[str]) -> Calibration:
    """The single camera of a cameras.txt: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`."""
    if len(lines) != 1:
        raise CalibrationError(f"{path}: {len(lines)} cameras; a file with the one to be used is needed")
    _, model, width, height, *words = lines[0].split()
    if model not in COLMAP_MODELS:
        raise CalibrationError(
            f"{path}: camera model {model} is not known; there are {', '.join(COLMAP_MODELS)}"
        )
    keys = COLMAP_MODELS[model].split()
    numbers = parse_floats(" ".join(words), str(path), CalibrationError)
    if len(numbers) != len(keys):
        raise CalibrationError(f"{path}: {model} has the parameters {' '.join(keys)}, got {len(numbers)}")
    values = dict(zip(keys, numbers, strict=True))
    fx, fy = (values.get(key, values.get("f", 0.0)) for key in ("fx", "fy"))
    kind = "fisheye" if model.endswith("FISHEYE") else ""
    coefficients = [values.get(key, 0.0) for key in MODELS[kind or "rational"].coefficients]
    intrinsics = [fx, fy, values["cx"] - HALF_PIXEL, values["cy"] - HALF_PIXEL]
    found = checked(intrinsics, coefficients, str(path), kind, (int(width), int(height)))
    return replace(found, as_stored=True)


def _from_transforms(keys: Keys, source: str) -> Calibration:
    """The camera that all frames of a transforms.json share; its pixels count from the corner of the top left one."""
    _check_shared(keys, source)
    size = keys.size()
    focal, angle = keys.number("flx"), keys.number("cameraanglex")
    if focal is None and size is not None and angle is not None:
        focal = 0.5 * size[0] / math.tan(0.5 * angle) if angle > 0 else 0.0
    if focal is None:
        raise CalibrationError(f"{source}: no fl_x in it that holds for all frames, nor w and camera_angle_x")
    intrinsics = [focal, keys.number("fly") or focal]
    for key, extent in zip(("cx", "cy"), size or (None, None), strict=True):
        center = keys.number(key)
        if center is None and extent is None:
            raise CalibrationError(f"{source}: no {key} in it, nor the size of the images")
        intrinsics.append((extent or 0.0) / 2 - HALF_PIXEL if center is None else center - HALF_PIXEL)
    found = _with_distortion(keys, intrinsics, source, size=size)
    if found.model == "rational":
        raise CalibrationError(
            f"{source}: k4 is not modeled as nerfstudio means it, the fourth term of a polynomial"
        )
    return replace(found, as_stored=True)


def _check_shared(keys: Keys, source: str) -> None:
    """Raise CalibrationError for a frame with a camera of its own."""
    found = keys.value("frames")
    for frame in found[1] if found is not None and isinstance(found[1], list) else ():
        for key in OF_A_CAMERA if isinstance(frame, dict) else ():
            if key not in frame:
                continue
            shared = keys.value(_normal(key))
            if frame[key] != (0 if shared is None else shared[1]):
                raise CalibrationError(
                    f"{source}: frame {str(frame.get('file_path', ''))[:80]} has a {key} of its own; "
                    "only one camera for all frames is read"
                )
