"""Cameras as users give them: the `--camera` argument and calibration files of other programs.

Files are of OpenCV, ROS, Kalibr, EuRoC, ORB-SLAM3, VINS, COLMAP and nerfstudio. Pixel (0, 0) is the center of the top
left pixel, as in OpenCV, ROS, Kalibr and ORB-SLAM3. COLMAP and nerfstudio use its corner, so their principal points are
larger by half a pixel.

A key that names a model or a distortion, and is not understood, is an error: without it, the camera is a wrong one.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchslam.data.calibration import (
    COUNTS,
    FROM_EXIF,
    PRESETS,
    UNKNOWN,
    Calibration,
    Size,
    parse_numbers,
    read_numbers,
)
from torchslam.data.formats.image_file import exif_block
from torchslam.data.formats.key_files import Keys, Tree, mappings, normal, read_tree
from torchslam.data.text_file import are_numbers, numbered_lines, parse_floats
from torchslam.errors import CalibrationError, FrameError
from torchslam.geometry.camera import Camera
from torchslam.geometry.distortion import MODELS
from torchslam.geometry.transforms import HALF_PIXEL


def read_focal(path: Path) -> Calibration:
    """Read the 35 mm equivalent focal length of an image file, relative to the diagonal. Raises CalibrationError."""
    try:
        found = exif_block(path, 0x8769).get(0xA405)  # camera data; the focal length, mm (EXIF 2.32)
    except FrameError as cause:
        raise CalibrationError(str(cause)) from cause
    if not isinstance(found, int | float) or not 0 < found < math.inf:
        raise CalibrationError(
            f"{path}: no 35 mm focal length in its EXIF block; give --camera f=0.8w or fov=65 instead"
        )
    diagonal = math.hypot(36.0, 24.0)  # of the film, millimeters
    return Calibration.guess(found / diagonal, "diagonal", f"EXIF of {path.name}, {found:g} mm")


def parse_camera(text: str, size: Size, example: Path | None = None) -> Camera:
    """Parse a `--camera` argument for images of `size` (width, height).

    Args:
        text: `fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]`, `fisheye,fx,fy,cx,cy,k1,k2,k3,k4`, a focal length as `f=0.8w`
            (widths of the image) or `f=500` (pixels), `fov=65` (horizontal, degrees), a preset such as
            `tum-fr1`, `exif`, `auto` (unknown), or a file (`read_calibration`)
        example: an image file, for `exif`

    Raises:
        CalibrationError: if the text or the file is invalid
    """
    given = parse_calibration(text)
    return (read_focal(example) if given == FROM_EXIF and example is not None else given).camera(size)


def parse_calibration(text: str, source: str = "--camera") -> Calibration:
    """Parse a `--camera` argument before the image size is known; see `parse_camera`.

    Raises CalibrationError naming `source`.
    """
    known = {**PRESETS, "exif": FROM_EXIF, "auto": UNKNOWN}
    word = text.strip()
    if word.lower() in known:
        return known[word.lower()]
    if os.path.isfile(word):  # Path.is_file raises for a name that is too long
        return read_calibration(word)
    if word.lower().startswith(("f=", "fov=")):
        return _parse_focal(word.lower(), source)
    if re.fullmatch(r"[^\s,]+", word) and not are_numbers([word]) and word not in COUNTS:
        near = difflib.get_close_matches(word.lower(), known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"presets are {', '.join(PRESETS)}"
        raise CalibrationError(f"{source}: `{word}` is not a number, a file or a known camera; {hint}")
    return parse_numbers(text, source)


def _parse_focal(word: str, source: str) -> Calibration:
    """`f=0.8w`, `f=500`, `f=500px` or `fov=65`."""
    angle = re.fullmatch(r"fov=([^,\s]+)", word)
    focal = re.fullmatch(r"f=([^wpx,\s]+)(w|px)?", word)
    if angle is not None:
        (degrees,) = parse_floats(angle[1], source, CalibrationError)
        if not 0 < degrees < 180:
            raise CalibrationError(f"{source}: fov={degrees:g} is no angle between 0 and 180 degrees")
        return Calibration.guess(0.5 / math.tan(math.radians(degrees) / 2), "w", word)
    if focal is None:
        raise CalibrationError(f"{source}: expected f=0.8w, f=500 or fov=65, got `{word}`")
    (length,) = parse_floats(focal[1], source, CalibrationError)
    if length <= 0:
        raise CalibrationError(f"{source}: the focal length must be positive, got {length:g}")
    return Calibration.guess(length, focal[2] or "px", word)


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
CAMERA_MODEL = ("cameramodel", "modeltype", "cameratype", "projectionmodel")
INTRINSICS = (("fx", "fu"), ("fy", "fv"), ("cx", "cu", "ppx"), ("cy", "cv", "ppy"))
LOOKS_LIKE_DISTORTION = re.compile(r"dist(?!an)|coef|fisheye|^(camera1?)?(k[1-9]|p[1-9])$|^xi$")
"""Of keys that were not used."""

# COLMAP, src/colmap/sensor/models.h, in the order of its numbers without 7 (FOV): where each parameter goes among
# fx fy cx cy and the distortion, of a fisheye where the name ends so.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file, recognized by its content.

    Supported are a line of numbers (`parse_numbers`, optionally with a `distortion.txt` next to it), OpenCV's YAML
    and XML, the same keys in JSON and in YAML of other programs, ROS camera_info, Kalibr's camchain, EuRoC's
    sensor.yaml, ORB-SLAM3's and stella_vslam's settings, VINS' cameras, COLMAP's cameras.txt and nerfstudio's
    transforms.json.

    Raises CalibrationError naming the file.
    """
    path = Path(path)
    tree = read_tree(path)
    if tree is not None:
        return _from_tree(path, tree)
    lines = [line for _, line in numbered_lines(path, CalibrationError)]
    if lines and re.match(r"(?a)\d+\s+[A-Z][A-Z_0-9]+\s+\d{1,9}\s+\d{1,9}\s", lines[0]):
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

    `intrinsics` are fx fy cx cy. Raises CalibrationError for models and coefficients that torchslam does not have.
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
    if word not in (*known, *FISHEYES):
        shown = ", ".join(word for word in (*known, *FISHEYES) if word)
        raise CalibrationError(f"{source}: {of} model `{name}` is not known; there are {shown}")
    return word in FISHEYES


def _from_tree(path: Path, tree: Tree) -> Calibration:
    """The first camera of a file of keys; keys above it hold for it, too."""
    # stella_vslam writes `Camera:` with keys below, ORB-SLAM3 `Camera.fx`.
    nested = {
        f"{name}.{key}": value
        for name in ("Camera", "Camera1")
        if isinstance(tree.get(name), dict)
        for key, value in tree[name].items()
    }
    for chain in mappings({**tree, **nested}):
        keys = Keys({key: value for each in reversed(chain) for key, value in each.items()}, str(path))
        here = Keys(chain[-1], str(path))
        prefix = next((each for each in ("camera1", "camera") if (f"{each}fx",) in here), "")
        if prefix:
            found = _from_single_keys(keys, prefix)
        elif ("flx", "cameraanglex") in here or has_cameras(here.value("frames")):
            found = _from_transforms(keys)
        elif ("intrinsics",) in here:
            found = _from_intrinsics(keys)
        elif MATRIX in here and len(here.numbers(*MATRIX)) != 1:
            found = _from_matrix(keys)
        elif all(names in here for names in INTRINSICS):
            found = _from_single_keys(keys, "", ("model",))
        else:
            continue
        if unused := keys.unused(LOOKS_LIKE_DISTORTION):
            raise _not_understood(keys, unused)
        return found
    _has_fisheye_model(Keys(tree, str(path)), "camera", CAMERA_MODEL)
    raise CalibrationError(
        f"{path}: no camera in it; looked for camera_matrix (OpenCV, ROS), intrinsics (Kalibr, EuRoC), "
        "Camera.fx (ORB-SLAM3), fl_x for all frames (nerfstudio), and fx fy cx cy"
    )


def _not_understood(keys: Keys, name: str) -> CalibrationError:
    return CalibrationError(
        f"{keys.source}: `{name}` looks like a distortion, but is not understood; "
        "call it distortion_coefficients, k1 k2 p1 p2 [k3 [k4 k5 k6]], or remove it"
    )


def _size(keys: Keys, prefixes: tuple[str, ...]) -> Size | None:
    """The size of the images, if it is there; zeros stand for an unknown one, as in ROS.

    Raises CalibrationError if only one side is there, or not positive.
    """
    sides = keys.numbers("resolution", "imagesize")
    if len(sides) != 2:
        names = ([prefix + key for prefix in prefixes for key in side] for side in (WIDTH, HEIGHT))
        sides = [keys.number(*side) or 0.0 for side in names]
    if not any(sides):
        return None
    if min(sides) < 1:
        raise CalibrationError(
            f"{keys.source}: the size of the images must be positive, got {sides[0]:g}x{sides[1]:g}"
        )
    return int(sides[0]), int(sides[1])


def _has_fisheye_model(keys: Keys, of: str, names: tuple[str, ...]) -> bool:
    words = [keys.text(name) for name in names]
    return True in [_is_fisheye(word, of, keys.source) for word in words if word]


def _with_distortion(
    keys: Keys, intrinsics: list[float], prefix: str = "", model_keys: tuple[str, ...] = ()
) -> Calibration:
    """A camera with the size, the model and the coefficients that its keys name.

    `intrinsics` are fx fy cx cy, `prefix` is that of keys of single coefficients, `model_keys` may name the model, too.
    """
    # All keys are looked at, and are used then.
    flags = [keys.flag(key) for key in ("fisheyemodel", "isfisheye", "usefisheye", "fisheye")]
    flags.append(_has_fisheye_model(keys, "camera", (*CAMERA_MODEL, *model_keys)))
    flags.append(_has_fisheye_model(keys, "distortion", ("distortionmodel", "distortiontype")))
    if keys.number("xi"):
        raise CalibrationError(f"{keys.source}: camera model `omnidirectional` (xi) is not known")
    kind = "fisheye" if any(flags) else ""
    names = MODELS[kind or "rational"].coefficients
    inner = keys.inner(*DISTORTION)
    if inner is not None:
        coefficients = _single_coefficients(inner, names, "")
        if not coefficients:
            raise CalibrationError(f"{inner.source}: expected k1 k2 p1 p2 [k3]")
        if unused := inner.unused(LOOKS_LIKE_DISTORTION):
            raise _not_understood(inner, unused)
    elif DISTORTION in keys:
        coefficients = keys.numbers(*DISTORTION)
    else:
        coefficients = _single_coefficients(keys, names, prefix)
    size = (_size(keys, ("camera", prefix)) if prefix else None) or _size(keys, ("",))
    return checked(intrinsics, coefficients, keys.source, kind, size)


def _single_coefficients(keys: Keys, names: tuple[str, ...], prefix: str) -> list[float]:
    values = [keys.number(prefix + name) for name in names]
    return [] if all(value is None for value in values) else [value or 0.0 for value in values]


def _from_matrix(keys: Keys) -> Calibration:
    matrix = keys.numbers(*MATRIX)
    if len(matrix) != 9:
        raise CalibrationError(f"{keys.source}: a camera matrix has 9 numbers, not {len(matrix)}")
    fx, skew, cx, zero, fy, cy, *last = matrix
    if [zero, *last] != [0, 0, 0, 1]:
        raise CalibrationError(f"{keys.source}: a camera matrix is fx 0 cx, 0 fy cy, 0 0 1, not {matrix}")
    if skew:
        raise CalibrationError(f"{keys.source}: a skew of {skew:g} is not modeled; calibrate without it")
    return _with_distortion(keys, [fx, fy, cx, cy])


def _from_intrinsics(keys: Keys) -> Calibration:
    """The first camera of Kalibr's camchain, or EuRoC's sensor.yaml."""
    _has_fisheye_model(keys, "camera", CAMERA_MODEL)  # of another model, there may be other numbers
    inner = keys.inner("intrinsics")
    if inner is not None:
        numbers = [number for names in INTRINSICS if (number := inner.number(*names)) is not None]
    else:
        numbers = keys.numbers("intrinsics")
    if len(numbers) != 4:
        raise CalibrationError(
            f"{keys.source}: expected `intrinsics: [fx, fy, cx, cy]`, got {len(numbers)} numbers"
        )
    return _with_distortion(keys, numbers)


def _from_single_keys(keys: Keys, prefix: str, model_keys: tuple[str, ...] = ()) -> Calibration:
    """Keys fx, fy, cx and cy, as in the settings of ORB-SLAM2, ORB-SLAM3 and stella_vslam, where they have a prefix."""
    values = [keys.number(*(prefix + name for name in names)) for names in INTRINSICS]
    intrinsics = [value for value in values if value is not None]
    if len(intrinsics) != 4:
        raise CalibrationError(f"{keys.source}: {prefix}.fx, fy, cx and cy are needed")
    return _with_distortion(keys, intrinsics, prefix, model_keys)


def from_colmap(path: Path, lines: list[str], used: Collection[str] | None = None) -> Calibration:
    """The camera of a cameras.txt, `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`, once or with equal parameters.

    used: numbers of the cameras of the images; None: all
    """
    cameras = {number: words for number, *words in map(str.split, lines)}
    used = cameras if used is None else used
    missing = [number for number in used if number not in cameras]
    if missing:
        raise CalibrationError(f"{path}: no camera {missing[0]}, which an image has")
    different = {tuple(cameras[number]) for number in used}
    if len(different) != 1:
        raise CalibrationError(
            f"{path}: {len(different)} cameras with different parameters; the images of one are needed, or --camera"
        )
    ((model, width, height, *words),) = different
    if model not in COLMAP_MODELS:
        raise CalibrationError(
            f"{path}: camera model {model} is not known; there are {', '.join(COLMAP_MODELS)}"
        )
    names = COLMAP_MODELS[model]
    numbers = parse_floats(" ".join(words), str(path), CalibrationError)
    if len(numbers) != len(names.split()):
        raise CalibrationError(f"{path}: {model} has the parameters {names}, got {len(numbers)}")
    values = dict(zip(names.split(), numbers, strict=True))
    fx, fy = (values.get(key, values.get("f", 0.0)) for key in ("fx", "fy"))
    kind = "fisheye" if model.endswith("FISHEYE") else ""
    coefficients = [values.get(key, 0.0) for key in MODELS[kind or "rational"].coefficients]
    intrinsics = [fx, fy, values["cx"] - HALF_PIXEL, values["cy"] - HALF_PIXEL]
    sides = [int(side) for side in (width, height) if side.isascii() and side.isdigit()]
    if len(sides) != 2:
        raise CalibrationError(f"{path}: width and height must be whole numbers, got {width} and {height}")
    found = checked(intrinsics, coefficients, str(path), kind, (sides[0], sides[1]))
    return replace(found, as_stored=True)


OF_FRAMES = (
    *("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "is_fisheye"),
    *MODELS["rational"].coefficients,
)
"""Keys of the camera in a transforms.json, for all frames or of each."""


def has_cameras(frames: Any) -> bool:
    """Whether frames of a transforms.json have focal lengths of their own."""
    of_frames = frames if isinstance(frames, list) else ()
    return any(
        isinstance(frame, dict) and not {"fl_x", "camera_angle_x"}.isdisjoint(frame) for frame in of_frames
    )


def _from_transforms(keys: Keys) -> Calibration:
    """The one camera of the frames of a transforms.json, stated for all of them or equally by each.

    Its pixels count from the corner of the top left one.
    """
    source, frames = keys.source, keys.value("frames") if ("frames",) in keys else ()
    shared = {key: keys.value(normal(key)) or None for key in OF_FRAMES if (normal(key),) in keys}
    cameras: dict[str, dict[str, Any]] = {}  # the first one, by the frame that has it
    for frame in (each for each in frames if isinstance(each, dict)) if isinstance(frames, list) else ():
        own = {key: frame[key] or None for key in OF_FRAMES if key in frame}
        both, name = shared | own, str(frame.get("file_path", ""))[:80]
        for other, camera in {"all frames": own | shared, **cameras}.items():
            if (
                key := next((key for key in OF_FRAMES if camera.get(key) != both.get(key)), None)
            ) is not None:
                raise CalibrationError(
                    f"{source}: the frames have different cameras: {key} is {camera.get(key) or 'missing'} of {other}, "
                    f"{both.get(key) or 'missing'} of {name}; give the images of one camera, or --camera for all"
                )
        cameras = cameras or {name: both}
    if cameras:
        keys = keys.with_values(next(iter(cameras.values())))
    size = _size(keys, ("",))
    focal, angle = keys.number("flx"), keys.number("cameraanglex")
    if focal is None and size is not None and angle is not None:
        if not 0 < angle < math.pi:
            raise CalibrationError(f"{source}: camera_angle_x is {angle:g}, no angle of an image in radians")
        focal = 0.5 * size[0] / math.tan(0.5 * angle)
    if focal is None:
        raise CalibrationError(f"{source}: no fl_x in it that holds for all frames, nor w and camera_angle_x")
    intrinsics = [focal, keys.number("fly") or focal]
    for key, extent in zip(("cx", "cy"), size or (None, None), strict=True):
        center = keys.number(key)
        if center is None and extent is None:
            raise CalibrationError(f"{source}: no {key} in it, nor the size of the images")
        intrinsics.append((extent or 0.0) / 2 - HALF_PIXEL if center is None else center - HALF_PIXEL)
    found = _with_distortion(keys, intrinsics)
    if found.model == "rational":
        raise CalibrationError(
            f"{source}: k4 is not modeled as nerfstudio means it, the fourth term of a polynomial"
        )
    return replace(found, as_stored=True)
