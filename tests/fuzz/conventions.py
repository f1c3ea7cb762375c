"""Undamaged calibration files in the conventions of many programs: read as what they mean, or refused.

Each has a camera, a program's format, a spelling of the keys and a size of the images; `truth.json` says what it means.
"""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any

from tests.fuzz.mutators import Files
from torchslam.data import read_calibration
from torchslam.errors import CalibrationError

TRUTH = "truth.json"
SIZES = [(640, 480), (752, 480), (1920, 1080), (480, 640)]
SCALES = [2.0, 0.5, 1.5, 1.25, 0.75]
"""Of the size for which a calibration was made, relative to the images."""
DISTORTION_KEYS = [
    *("distortion_coefficients", "dist_coeffs", "dist_coeff", "distCoeffs", "Distortion_Coefficients", "D"),
    *("dist", "distortion", "DistCoeffs", "dist_coefs", "distortion_coeffs"),
]
STRANGE_KEYS = ["lens_distortion", "distortionVector", "undistortion_coeff", "dist_left", "coefficients"]
MATRIX_KEYS = ["camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "mtx", "intrinsic_matrix"]
BROWN_NAMES, FISHEYE_NAMES = ["plumb_bob", "radtan", "radial-tangential"], ["equidistant", "fisheye"]
STRANGE_MODELS = ["fov", "omni", "mei", "thin_prism_fisheye", "scaramuzza", "ds", "eucm", "division"]


class Meant:
    """A camera, and how it is written down."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.size = rng.choice(SIZES)
        self.scale = rng.choice(SCALES) if rng.random() < 0.3 else 1.0
        self.model = rng.choice(["pinhole", "radial_tangential", "radial_tangential", "fisheye"])
        self.is_strange = rng.random() < 0.25  # it has a word that nobody knows
        width, height = (side * self.scale for side in self.size)
        focal = width * rng.uniform(0.5, 1.2)
        center = [(side - 1) / 2 + width * rng.uniform(-0.02, 0.02) for side in (width, height)]
        self.intrinsics = [round(number, 4) for number in (focal, focal * rng.uniform(0.98, 1.02), *center)]
        count = {"pinhole": 0, "radial_tangential": rng.choice((4, 5)), "fisheye": 4}[self.model]
        self.coefficients = [round(rng.uniform(-0.2, 0.2), 5) or 0.1 for _ in range(count)]
        self.made_for = round(width), round(height)

    @property
    def is_fisheye(self) -> bool:
        return self.model == "fisheye"

    def named(self) -> str:
        """One of the names of the distortion's model."""
        return self.rng.choice(FISHEYE_NAMES if self.is_fisheye else BROWN_NAMES)

    def singles(self) -> dict[str, float]:
        """The coefficients by their names."""
        names = ("k1", "k2", "k3", "k4") if self.is_fisheye else ("k1", "k2", "p1", "p2", "k3")
        return dict(zip(names, self.coefficients, strict=False))

    def matrix(self) -> list[list[float]]:
        fx, fy, cx, cy = self.intrinsics
        return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def example(rng: random.Random) -> Files:
    """A calibration file, and what it means."""
    meant = Meant(rng)
    programs = (_opencv, _opencv_xml, _lists, _kalibr, _orb_slam, _vins, _colmap, _transforms, _numbers)
    name, text = rng.choice(programs)(meant)
    truth = {
        # Another size is known by the one that is stated, or by the principal point.
        "verdict": "refused" if meant.is_strange or meant.scale != 1.0 else "read",
        "model": meant.model,
        "params": [*meant.intrinsics, *meant.coefficients],
        "size": meant.size,
    }
    return {name: text.encode(), TRUTH: json.dumps(truth).encode()}


def check(root: Path) -> None:
    """Raise AssertionError for a file that is read as another camera, or refused though it is right."""
    truth = json.loads((root / TRUTH).read_text())
    (path,) = (path for path in root.iterdir() if path.name != TRUTH)
    size = tuple(truth["size"])
    if truth["verdict"] == "refused":
        camera = read_calibration(path).camera(size)
        raise AssertionError(f"read as {camera}")
    try:
        camera = read_calibration(path).camera(size)
    except CalibrationError as error:
        raise AssertionError("is right, but refused") from error
    found = camera.params.tolist()
    expected = truth["params"] + [0.0] * (len(found) - len(truth["params"]))
    assert camera.model == truth["model"], camera.model
    assert all(math.isclose(*both, abs_tol=1e-6) for both in zip(found, expected, strict=True)), found


def _coefficient_key(meant: Meant) -> str:
    return meant.rng.choice(STRANGE_KEYS if meant.is_strange else DISTORTION_KEYS)


def _opencv_tree(meant: Meant) -> dict[str, Any]:
    """A camera matrix, coefficients and perhaps the size."""
    rng = meant.rng
    if meant.is_strange and not meant.coefficients:
        meant.coefficients = [0.1, 0.2, 0.01, 0.02]
    tree: dict[str, Any] = {"calibration_time": "today", rng.choice(MATRIX_KEYS): meant.matrix()}
    if meant.coefficients:
        tree[_coefficient_key(meant)] = [meant.coefficients]
    if meant.is_fisheye:
        tree[rng.choice(["fisheye_model", "is_fisheye"])] = 1
    elif rng.random() < 0.3:
        tree["fisheye_model"] = 0
    if rng.random() < 0.5:
        tree |= dict(zip(("image_width", "image_height"), meant.made_for, strict=True))
    return tree


def _opencv(meant: Meant) -> tuple[str, str]:
    """As cv2.FileStorage and ROS write it."""
    tree = _opencv_tree(meant)
    lines = ["%YAML:1.0", "---"] if meant.rng.random() < 0.5 else []
    for key, value in tree.items():
        if isinstance(value, list):
            numbers = [number for row in value for number in row]
            lines += [f"{key}: !!opencv-matrix", f"   rows: {len(value)}", "   dt: d"]
            lines += [f"   data: [ {', '.join(map(repr, numbers))} ]"]
        else:
            lines.append(f"{key}: {value}")
    return "c.yaml", "\n".join(lines) + "\n"


def _opencv_xml(meant: Meant) -> tuple[str, str]:
    tree = _opencv_tree(meant)
    body = ""
    for key, value in tree.items():
        if isinstance(value, list):
            numbers = " ".join(repr(number) for row in value for number in row)
            value = f"<rows>{len(value)}</rows><dt>d</dt><data>\n{numbers}</data>"
        body += f"<{key}>{value}</{key}>\n"
    return "c.xml", f'<?xml version="1.0"?>\n<opencv_storage>\n{body}</opencv_storage>\n'


def _lists(meant: Meant) -> tuple[str, str]:
    """As people dump it with PyYAML and json."""
    tree = _opencv_tree(meant)
    if meant.rng.random() < 0.4:
        return "c.json", json.dumps(tree)
    text = ""
    for key, value in tree.items():
        if isinstance(value, list) and meant.rng.random() < 0.5:
            rows = ["- - " + "\n  - ".join(map(str, row)) + "\n" for row in value]
            text += f"{key}:\n" + "".join(rows)
        else:
            text += f"{key}: {json.dumps(value)}\n"
    return "c.yaml", text


def _kalibr(meant: Meant) -> tuple[str, str]:
    """A camchain, or EuRoC's sensor.yaml, also by hand."""
    rng = meant.rng
    name = rng.choice(STRANGE_MODELS) if meant.is_strange else meant.named()
    fx, fy, cx, cy = meant.intrinsics
    intrinsics = rng.choice([f"[{fx}, {fy}, {cx}, {cy}]", f"[fx: {fx}, fy: {fy}, cx: {cx}, cy: {cy}]"])
    lines = ["camera_model: pinhole", f"intrinsics: {intrinsics}", f"distortion_model: {name}"]
    lines += [f"{rng.choice(['distortion_coeffs', 'distortion_coefficients'])}: {meant.coefficients}"]
    if rng.random() < 0.8:
        lines += [f"resolution: [{meant.made_for[0]}, {meant.made_for[1]}]"]
    rng.shuffle(lines)
    if rng.random() < 0.5:
        other = "cam1:\n  camera_model: omni\n  intrinsics: [1, 2, 3, 4, 5]\n"
        return "c.yaml", "cam0:\n" + "".join(f"  {line}\n" for line in lines) + other
    return "c.yaml", "\n".join(lines) + "\n"


def _orb_slam(meant: Meant) -> tuple[str, str]:
    """Settings of ORB-SLAM2, ORB-SLAM3 and stella_vslam."""
    rng = meant.rng
    prefix = rng.choice(["Camera.", "Camera1."])
    key = rng.choice(["type", "model"])
    name = "KannalaBrandt8" if meant.is_fisheye else rng.choice(["PinHole", "perspective"])
    lines = [f'Camera.{key}: "{rng.choice(STRANGE_MODELS) if meant.is_strange else name}"', "Camera.fps: 20"]
    numbers = dict(zip(("fx", "fy", "cx", "cy"), meant.intrinsics, strict=True)) | meant.singles()
    lines += [f"{prefix}{key}: {number}" for key, number in numbers.items()]
    if rng.random() < 0.7:
        sides = rng.choice([("width", "height"), ("cols", "rows")])
        lines += [f"Camera.{side}: {value}" for side, value in zip(sides, meant.made_for, strict=True)]
    rng.shuffle(lines)
    if prefix == "Camera." and rng.random() < 0.5:
        return "c.yaml", "\n".join(["Camera:", *(f"  {line[7:]}" for line in lines)]) + "\n"
    return "c.yaml", "\n".join(["%YAML:1.0", *lines]) + "\n"


def _vins(meant: Meant) -> tuple[str, str]:
    meant.coefficients = meant.coefficients[:4]
    if meant.is_fisheye:
        meant.model, meant.coefficients = "pinhole", []
    model = meant.rng.choice(STRANGE_MODELS) if meant.is_strange else "PINHOLE"
    width, height = meant.made_for
    lines = [f"model_type: {model}", f"image_width: {width}", f"image_height: {height}"]
    if meant.coefficients:
        lines += ["distortion_parameters:", *(f"   {key}: {value}" for key, value in meant.singles().items())]
    names = zip(("fx", "fy", "cx", "cy"), meant.intrinsics, strict=True)
    lines += ["projection_parameters:", *(f"   {key}: {value}" for key, value in names)]
    return "c.yaml", "\n".join(lines) + "\n"


def _colmap(meant: Meant) -> tuple[str, str]:
    meant.coefficients = meant.coefficients[:4]
    models = {"pinhole": "PINHOLE", "radial_tangential": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
    model = "FOV" if meant.is_strange else models[meant.model]
    fx, fy, cx, cy = meant.intrinsics
    numbers = " ".join(map(str, (fx, fy, cx + 0.5, cy + 0.5, *meant.coefficients)))
    return "c.txt", f"1 {model} {meant.made_for[0]} {meant.made_for[1]} {numbers}\n"


def _transforms(meant: Meant) -> tuple[str, str]:
    meant.coefficients = meant.coefficients[:4]
    fx, fy, cx, cy = meant.intrinsics
    tree: dict[str, Any] = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5} | meant.singles()
    if meant.is_strange:
        tree["camera_model"] = meant.rng.choice(["EQUIRECTANGULAR", "FISHEYE624", "ORTHOPHOTO"])
    elif meant.is_fisheye:
        tree |= meant.rng.choice([{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
    else:
        tree |= meant.rng.choice([{"camera_model": "OPENCV"}, {"is_fisheye": False}, {}])
    tree |= dict(zip("wh", meant.made_for, strict=True)) if meant.rng.random() < 0.7 else {}
    return "c.json", json.dumps(tree | {"frames": []})


def _numbers(meant: Meant) -> tuple[str, str]:
    words = [*(["fisheye"] if meant.is_fisheye else []), *meant.intrinsics, *meant.coefficients]
    if meant.is_strange:
        words.insert(0, meant.rng.choice(STRANGE_MODELS))
    return "c.txt", "# fx fy cx cy\n" + " ".join(map(str, words)) + "\n"
