"""What `--camera` may say: guesses, presets, EXIF, files of other programs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from torchslam.data import Calibrated, open_sequence, parse_camera, read_calibration
from torchslam.data.calibration import PRESETS, size_text
from torchslam.errors import CalibrationError

VGA = (640, 480)
BROWN = [500.0, 501.0, 320.5, 240.25, 0.1, -0.2, 0.01, 0.02, 0.0]


@pytest.mark.parametrize(
    ("text", "focal"),
    [
        ("f=0.8w", 512.0),
        ("f=500", 500.0),
        ("F=500px", 500.0),
        ("fov=90", 320.0),
        (" fov=60 ", 320 / math.tan(math.pi / 6)),
    ],
)
def test_focal_lengths(text: str, focal: float) -> None:
    camera = parse_camera(text, VGA)
    assert camera.model == "pinhole"
    assert camera.params.tolist() == pytest.approx([focal, focal, 319.5, 239.5])


def test_field_of_view_reaches_from_edge_to_edge() -> None:
    camera = parse_camera("fov=65", (1280, 720))
    edges = torch.tensor([[-0.5, 359.5], [1279.5, 359.5]], dtype=torch.float64)
    left, right = camera.unproject(edges)
    assert math.degrees(math.acos(float(left @ right))) == pytest.approx(65.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("f=", "expected f=0.8w, f=500 or fov=65"),
        ("f=w", "expected f=0.8w"),
        ("f=-3", "must be positive, got -3"),
        ("f=nan", "not a finite number"),
        ("f=1,2", "expected f=0.8w"),
        ("fov=180", "no angle between 0 and 180"),
        ("fov=0", "no angle"),
        ("fov=wide", "`wide` is not a number"),
        ("tum-fr4", r"not a number, a file or a known camera; did you mean tum-fr\d\?"),
        ("EuRoc2", r"did you mean euroc\?"),
        ("./camera.yaml", "`./camera.yaml` is not a number, a file or a known camera; presets are"),
        ("exif", "only image files"),
        ("x" * 5000, "is not a number, a file"),
    ],
)
def test_wrong_arguments(text: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=f"--camera:? .*{message}"):
        parse_camera(text, VGA)


@pytest.mark.parametrize("name", PRESETS)
def test_presets(name: str) -> None:
    for calibration in (PRESETS[name], *PRESETS[name].others):
        camera = parse_camera(name, calibration.size)
        center = torch.tensor([(camera.width - 1) / 2, (camera.height - 1) / 2], dtype=torch.float64)
        assert (camera.params[2:4] - center).abs().max() < 20
        assert 0.4 < float(camera.focal) / camera.width < 0.9
        assert camera.size == calibration.size


def test_preset_by_the_size_of_the_images() -> None:
    assert float(parse_camera("kitti", (1241, 376)).fx) == 718.856
    assert float(parse_camera("kitti", (1226, 370)).fx) == 707.0912
    with pytest.raises(
        CalibrationError, match=r"`kitti`: .*1241x376 or 1242x375 or 1226x370, these are 640x480"
    ):
        parse_camera("kitti", VGA)


@pytest.mark.data
@pytest.mark.parametrize(
    ("preset", "folder"), [("tum-fr2", "fr2_desk_20"), ("kitti", "kitti07"), ("euroc", "machine_hall")]
)
def test_presets_are_those_of_the_sequences(data_dir: Path, preset: str, folder: str) -> None:
    given = open_sequence(data_dir / folder).camera
    assert parse_camera(preset, given.size).params.tolist() == pytest.approx(
        given.params.tolist(), rel=1e-3, abs=2e-4
    )


def test_exif(tmp_path: Path) -> None:
    """28 mm on a 3:2 image, 36 mm wide on film, is 28/36 of the width."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28  # focal length, 35 mm film
    noise = np.random.default_rng(0).integers(0, 255, (64, 96), np.uint8)
    for index in range(2):
        Image.fromarray(noise).save(tmp_path / f"{index}.jpg", exif=exif)
    sequence = open_sequence(tmp_path, "exif")
    assert sequence.calibrated is Calibrated.GUESSED
    assert "(guessed)" in sequence.describe()["camera"]
    assert sequence.camera.params.tolist() == pytest.approx([96 * 28 / 36, 96 * 28 / 36, 47.5, 31.5])
    Image.fromarray(noise).save(tmp_path / "0.jpg")
    with pytest.raises(CalibrationError, match=r"0\.jpg: no 35 mm focal length"):
        open_sequence(tmp_path, "exif")


OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320.5, 0., 501.,
       240.25, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 1.0e-01, -2.0e-01, 1.0e-02, 2.0e-02, 0. ]
"""
ROS = """image_width: 640
image_height: 480
camera_name: left   # of two
camera_matrix:
  rows: 3
  cols: 3
  data: [500, 0, 320.5, 0, 501, 240.25, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.01, 0.02, 0]
projection_matrix:
  rows: 3
  cols: 4
  data: [1, 0, 2, 0, 0, 3, 4, 0, 0, 0, 1, 0]
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.01, 0.02]
  distortion_model: radtan
  intrinsics: [500.0, 501.0, 320.5, 240.25]
  resolution: [640, 480]
cam1:
  camera_model: pinhole
  intrinsics: [1.0, 2.0, 3.0, 4.0]
  resolution: [64, 48]
"""
ORB_SLAM = """%YAML:1.0
# Camera Parameters
Camera.type: "PinHole"
Camera1.fx: 500.0
Camera1.fy: 501.0   # pixels
Camera1.cx: 320.5
Camera1.cy: 240.25
Camera1.k1: 0.1
Camera1.k2: -0.2
Camera1.p1: 0.01
Camera1.p2: 0.02
Camera.width: 640
Camera.height: 480
"""
COLMAP = """# Camera list
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 OPENCV 640 480 500 501 321 240.75 .1 -.2 .01 .02
"""
NERFSTUDIO = """{"camera_model": "OPENCV", "w": 640, "h": 480, "fl_x": 500, "fl_y": 501, "cx": 321, "cy": 240.75,
"k1": 0.1, "k2": -0.2, "p1": 0.01, "p2": 0.02, "frames": [{"file_path": "images/0.png"}]}"""


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("opencv.yml", OPENCV),
        ("ros.yaml", ROS),
        ("camchain.yaml", KALIBR),
        ("settings.yaml", ORB_SLAM),
        ("settings.yaml", ORB_SLAM.replace("Camera1.", "Camera.")),
        ("cameras.txt", COLMAP),
        ("transforms.json", NERFSTUDIO),
    ],
)
def test_files(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    camera = parse_camera(str(tmp_path / name), VGA)
    assert camera.model == "radial_tangential"
    assert camera.params.tolist() == pytest.approx(BROWN)
    with pytest.raises(CalibrationError, match=f"images of 640x480, these are {size_text((64, 48))}"):
        parse_camera(str(tmp_path / name), (64, 48))


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_opencv_calibration_files_are_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[500, 0, 320.5], [0, 501, 240.25], [0, 0, 1.0]]))
    storage.write("distortion_coefficients", np.array(BROWN[4:]))
    storage.release()
    assert read_calibration(path).params == pytest.approx(BROWN)
    assert read_calibration(path).size == VGA


@pytest.mark.parametrize(
    ("line", "model", "params"),
    [
        ("SIMPLE_PINHOLE 640 480 500 320 240", "pinhole", [500, 500, 319.5, 239.5]),
        (
            "SIMPLE_RADIAL 640 480 500 320 240 .1",
            "radial_tangential",
            [500, 500, 319.5, 239.5, 0.1, 0, 0, 0, 0],
        ),
        (
            "RADIAL 640 480 500 320 240 .1 .2",
            "radial_tangential",
            [500, 500, 319.5, 239.5, 0.1, 0.2, 0, 0, 0],
        ),
        (
            "FULL_OPENCV 640 480 500 501 320 240 .1 .2 .3 .4 .5 0 0 0",
            "radial_tangential",
            [500, 501, 319.5, 239.5, 0.1, 0.2, 0.3, 0.4, 0.5],
        ),
        (
            "FULL_OPENCV 640 480 500 501 320 240 .1 .2 .3 .4 .5 .6 .7 .8",
            "rational",
            [500, 501, 319.5, 239.5, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8],
        ),
        ("OPENCV_FISHEYE 640 480 500 501 320 240 1 2 3 4", "fisheye", [500, 501, 319.5, 239.5, 1, 2, 3, 4]),
        ("RADIAL_FISHEYE 640 480 500 320 240 1 2", "fisheye", [500, 500, 319.5, 239.5, 1, 2, 0, 0]),
    ],
)
def test_colmap_camera_models_are_read(tmp_path: Path, line: str, model: str, params: list[float]) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 {line}\n")
    calibration = read_calibration(tmp_path / "cameras.txt")
    assert (calibration.model, calibration.size) == (model, VGA)
    assert calibration.params == pytest.approx(params)


@pytest.mark.parametrize(
    "line", ["OPENCV 640 480 500 501 320 240 .1 -.2 .01 .02", "SIMPLE_RADIAL 640 480 500 320 240 .1"]
)
def test_colmap_pixels_are_shifted_by_half_a_pixel(tmp_path: Path, line: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    (tmp_path / "cameras.txt").write_text(f"1 {line}\n")
    model, width, height, *params = line.split()
    theirs = pycolmap.Camera(
        model=model, width=int(width), height=int(height), params=[float(p) for p in params]
    )
    point = np.array([[0.1, -0.2, 1.0]])
    ours, _ = parse_camera(str(tmp_path / "cameras.txt"), VGA).project(torch.from_numpy(point))
    assert ours[0].numpy() == pytest.approx(theirs.img_from_cam(point).ravel() - 0.5)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yaml", KALIBR.replace("radtan", "equidistant")),
        ("b.yaml", ORB_SLAM.replace("PinHole", "KannalaBrandt8")),
        ("c.json", NERFSTUDIO.replace("OPENCV", "OPENCV_FISHEYE")),
        (
            "d.json",
            NERFSTUDIO.replace('"camera_model": "OPENCV"', '"is_fisheye": true')
            .replace("p1", "k3")
            .replace("p2", "k4"),
        ),
        ("e.yaml", ROS.replace("plumb_bob", "equidistant").replace(", 0]\nproj", "]\nproj")),
    ],
)
def test_fisheyes(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text.replace("p1", "k3").replace("p2", "k4"))
    calibration = read_calibration(tmp_path / name)
    assert calibration.model == "fisheye"
    assert calibration.params == pytest.approx(BROWN[:8])


PYYAML = """camera_matrix:
- - 500.0
  - 0.0
  - 320.5
- - 0.0
  - 501.0
  - 240.25
- - 0.0
  - 0.0
  - 1.0
dist_coeff:
- - 0.1
  - -0.2
  - 0.01
  - 0.02
  - 0.0
"""
LISTED = '{"K": [[500, 0, 320.5], [0, 501, 240.25], [0, 0, 1]], "D": [0.1, -0.2, 0.01, 0.02], "image_size": [640, 480]}'
VINS = """%YAML:1.0
---
model_type: PINHOLE
camera_name: front
image_width: 640
image_height: 480
distortion_parameters:
   k1: 0.1
   k2: -0.2
   p1: 0.01
   p2: 0.02
projection_parameters:
   fx: 500.0
   fy: 501.0
   cx: 320.5
   cy: 240.25
"""
STELLA = """Camera:
  name: "a front camera"
  setup: "monocular"
  model: "perspective"
  fx: 500.0
  fy: 501.0
  cx: 320.5
  cy: 240.25
  k1: 0.1
  k2: -0.2
  p1: 0.01
  p2: 0.02
  k3: 0.0
  fps: 30.0
  cols: 640
  rows: 480
"""


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("pyyaml.yaml", PYYAML),
        (
            "flow.yaml",
            "camera_matrix: [[500.0, 0, 320.5], [0, 501, 240.25],\n  [0, 0, 1]]\ndist: [[.1, -.2, .01, .02]]\n",
        ),
        ("json.json", LISTED),
        ("vins.yaml", VINS),
        ("stella.yaml", STELLA),
        ("stella.yaml", STELLA.replace("\n  ", "\nCamera.").replace("Camera:\n", "")),
        ("scalars.yaml", "K: [500, 0, 320.5, 0, 501, 240.25, 0, 0, 1]\nk1: .1\nk2: -.2\np1: .01\np2: .02\n"),
        ("named.yaml", PYYAML.replace("dist_coeff", "distCoeffs")),
        (
            "nested.yaml",
            "left:\n" + "".join(f"  {line}\n" for line in PYYAML.splitlines()) + "right:\n  K: []\n",
        ),
        ("tuple.yaml", PYYAML.replace("dist_coeff:", "dist_coeff: !!python/tuple")),
    ],
)
def test_distortions_by_any_name_are_read(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    calibration = read_calibration(tmp_path / name)
    assert calibration.params == pytest.approx(BROWN)
    assert calibration.size == (VGA if "640" in text else None)


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("model", [0, 1])
def test_opencv_files_say_whether_they_are_of_a_fisheye(tmp_path: Path, suffix: str, model: int) -> None:
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array([[500, 0, 320.5], [0, 501, 240.25], [0, 0, 1.0]]))
    storage.write("fisheye_model", model)
    storage.write("distortion_coefficients", np.array([[0.1], [-0.2], [0.01], [0.02]]))
    storage.release()
    calibration = read_calibration(path)
    assert calibration.model == ("fisheye" if model else "radial_tangential")
    assert calibration.params[:8] == pytest.approx(BROWN[:8])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", PYYAML.replace("dist_coeff", "my_distortion"), "`my_distortion` looks like a distortion"),
        ("a.yaml", PYYAML + "distortion_coefficients_2: [0.1]\n", "`distortion_coefficients_2` looks like"),
        ("a.yaml", ORB_SLAM + "Camera1.p3: 0.1\n", "`Camera1.p3` looks like a distortion"),
        ("a.json", NERFSTUDIO.replace('"p1"', '"k4": 0.1, "p1"'), "k4 is not modeled as nerfstudio means it"),
        ("a.yaml", PYYAML + "xi: 1.2\n", r"camera model `omnidirectional` \(xi\) is not known"),
        ("a.yaml", ORB_SLAM.replace("PinHole", "OCam"), "camera model `ocam` is not known"),
        ("a.yaml", STELLA.replace("perspective", "equirectangular"), "camera model `equirectangular`"),
        ("a.yaml", VINS.replace("PINHOLE", "MEI"), "camera model `mei` is not known"),
        ("a.yaml", "model_type: SCARAMUZZA\n", "camera model `scaramuzza` is not known"),
        ("a.yaml", ROS.replace("plumb_bob", "thin_prism"), "distortion model `thin_prism` is not known"),
        ("a.json", NERFSTUDIO.replace("OPENCV", "FISHEYE624"), "camera model `fisheye624` is not known"),
        ("a.json", NERFSTUDIO.replace("OPENCV", "EQUIRECTANGULAR"), "camera model `equirectangular`"),
        (
            "a.json",
            '{"model": "Inverse Brown Conrady", "fx": 5, "fy": 5, "ppx": 3, "ppy": 2}',
            "`inverse brown",
        ),
        (
            "a.xml",
            "<a><K>5 0 3 0 5 2 0 0 1</K><distortion_model>omni</distortion_model></a>",
            "distortion model `omni` is not known",
        ),
        (
            "a.json",
            NERFSTUDIO.replace('"images/0.png"', '"images/0.png", "k1": 0.3'),
            "different cameras: k1 is 0.1 of all frames, 0.3 of images/0.png",
        ),
        (
            "a.json",
            NERFSTUDIO.replace('"images/0.png"', '"images/0.png", "k4": 0.3'),
            "k4 is not modeled",
        ),
        ("a.txt", "1 FISHEYE624 64 48 5 5 3 2\n", "camera model FISHEYE624 is not known"),
        ("a.yaml", "K: [5, 0, 0, 0, 5, 0, 3, 2, 1]\n", "a camera matrix is fx 0 cx, 0 fy cy, 0 0 1, not"),
        ("a.yaml", "K: [5, 1, 3, 0, 5, 2, 0, 0, 1]\n", "a skew of 1 is not modeled"),
        ("a.yaml", "nothing: 1\n", "no camera in it; looked for"),
        ("a.yaml", "camera_matrix: [1, 2, 3]\n", "a camera matrix has 9 numbers, not 3"),
        ("a.yaml", KALIBR.replace("radtan", "fov"), "distortion model `fov` is not known"),
        ("a.yaml", KALIBR.replace("pinhole", "omni"), "camera model `omni` is not known"),
        ("a.yaml", KALIBR.replace("500.0, 501.0", "500.0, -1"), "focal lengths must be positive"),
        (
            "a.yaml",
            ROS.replace("0.02, 0]", "0.02, 0, 0.5, 0]"),
            "of 7 distortion coefficients more than k1 k2 p1 p2",
        ),
        ("a.yaml", ORB_SLAM.replace("Camera1.cy", "Camera1.c"), "fx, fy, cx and cy are needed"),
        ("a.txt", "1 OPENCV 640 480 500 501 320 240\n", "OPENCV has the parameters fx fy"),
        ("a.txt", "1 FOV 640 480 500 501 320 240 1\n", "camera model FOV is not known"),
        ("a.txt", "1 PINHOLE 4 4 5 5 3 2\n2 PINHOLE 4 4 5 6 3 2\n", "2 cameras with different parameters"),
        (
            "a.json",
            '{"w": 8, "h": 6, "frames": [{"file_path": "a", "fl_x": 500}, {"file_path": "b", "fl_x": 501}]}',
            "different cameras: fl_x is 500 of a, 501 of b",
        ),
        (
            "a.json",
            '{"w": 8, "h": 6, "frames": [{"file_path": "a", "fl_x": 500}, {"file_path": "b"}]}',
            "different cameras: fl_x is 500 of a, missing of b",
        ),
        ("a.json", "{}", "no camera in it; looked for"),
        ("a.json", "{]", "not valid JSON"),
        ("a.json", '{"fl_x": NaN}', "fl_x: nan is not finite"),
        ("a.json", '{"fl_x": 500}', "no cx in it"),
        ("a.xml", "<a>", "not valid XML"),
        ("a.xml", "<!DOCTYPE a [<!ENTITY b 'c'>]><a/>", "entities are not read"),
        ("a.xml", "<a/>", "no camera in it; looked for"),
    ],
)
def test_wrong_files(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationError, match=rf"{name}: .*{message}"):
        read_calibration(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yaml", PYYAML + "k4: 0\nmarker_distance: 2.5\nfisheye: false\ndistortion_type: none\n"),
        # A frame may repeat the shared camera.
        ("a.json", NERFSTUDIO.replace('"images/0.png"', '"images/0.png", "k1": 0.1, "w": 640')),
    ],
)
def test_keys_that_are_no_other_distortion(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert read_calibration(tmp_path / name).params == pytest.approx(BROWN)


def test_angle_of_a_blender_scene(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text(f'{{"camera_angle_x": {math.pi / 2}, "w": 640, "h": 480, "frames": []}}')
    assert read_calibration(tmp_path / "t.json").params == pytest.approx([320, 320, 319.5, 239.5])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"camera_angle_x": 40, "w": 640, "h": 480, "frames": []}', "camera_angle_x is 40, no angle"),
        (
            '{"fx": 500, "fy": 500, "cx": 0, "cy": 0, "width": 640, "height": 480}',
            "the principal point 0, 0: are",
        ),
        (
            '{"fx": 0.8, "fy": 1.1, "cx": 0.5, "cy": 0.5}',
            "0.8, 1.1 pixels with the principal point 0.5, 0.5: are these parts",
        ),
    ],
)
def test_focal_lengths_in_other_units(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(CalibrationError, match=f"t.json: .*{message}"):
        read_calibration(tmp_path / "t.json")


def test_a_decimal_comma_does_not_cut_a_number(tmp_path: Path) -> None:
    lines = "%YAML:1.0\nCamera.fx: 517,3\nCamera.fy: 516.4\nCamera.cx: 318\nCamera.cy: 255\n"
    (tmp_path / "c.yaml").write_text(lines)
    with pytest.raises(CalibrationError, match=r"c.yaml: Camera.fx: `517,3` is not one number"):
        parse_camera(str(tmp_path / "c.yaml"), (640, 480))


def test_frames_with_equal_cameras_have_one(tmp_path: Path) -> None:
    """As Polycam writes them, and COLMAP with a camera for each image."""
    whole = json.loads(NERFSTUDIO)
    camera = {key: whole.pop(key) for key in list(whole) if key != "frames"}
    whole["frames"] = [{"file_path": f"images/{index}.png"} | camera for index in range(3)]
    (tmp_path / "t.json").write_text(json.dumps(whole))
    (tmp_path / "t.txt").write_text(COLMAP + COLMAP.splitlines()[-1].replace("1 ", "2 ", 1) + "\n")
    for name in ("t.json", "t.txt"):
        found = read_calibration(tmp_path / name)
        assert found.params == pytest.approx(BROWN)
        assert found.size == VGA
