"""Good inputs of every kind, as small as they can be: the files of each by their names."""

from __future__ import annotations

import io
import random
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from tests.data.formats.test_fix_files import GPX, MAVIC_3, MAVIC_PRO, MINI_2, NMEA, with_sums
from tests.data.mp4 import write_mp4
from tests.data.readers.test_bag import STAMPS, Recording
from tests.data.test_camera_argument import (
    COLMAP,
    KALIBR,
    LISTED,
    NERFSTUDIO,
    OPENCV,
    ORB_SLAM,
    PYYAML,
    ROS,
    STELLA,
    VINS,
)
from tests.data.test_datasets import CAM_TO_CAM
from tests.fuzz.mutators import Files
from torchslam.config import Config, to_toml

SENSOR = """\
%YAML:1.0
# Default camera sensor yaml file
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.1,
         1.0, 0.0, 0.0, 0.2,
        0.0, 0.0, 1.0, 0.3,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [58.6, 57.2, 31.2, 23.3] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
SIZE = (64, 48)
VGA = (640, 480)


def picture(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """(H, W) uint8, smooth, so that its file is small."""
    noise = np.random.default_rng(seed).integers(0, 256, (6, 8), dtype=np.uint8)
    return cv2.resize(noise, size, interpolation=cv2.INTER_LINEAR)


def encoded(image: np.ndarray, suffix: str = ".png") -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


def pictures(names: list[str], size: tuple[int, int] = SIZE) -> Files:
    return {name: encoded(picture(index, size), Path(name).suffix) for index, name in enumerate(names)}


def place(folder: Path, files: Files) -> Path:
    """Write files below a folder, and return it."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


def content_of(folder: Path) -> Files:
    """The files below a folder."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@cache
def images() -> dict[str, Files]:
    """An image of every kind that is read."""
    color = np.stack([picture(index) for index in range(3)], axis=-1)
    kinds = ("png", "jpg", "bmp", "tif", "webp", "pgm")
    found = {suffix: encoded(picture(1), f".{suffix}") for suffix in kinds}
    found |= {kind: encoded(color, "." + kind.split(".")[-1]) for kind in ("ppm", "color.png", "color.jpg")}
    found["1.png"] = bytes(cv2.imencode(".png", picture(1) // 128 * 255, [cv2.IMWRITE_PNG_BILEVEL, 1])[1])
    found["16.png"] = encoded(picture(1).astype(np.uint16) * 100)
    return {kind: {f"a.{kind}": content} for kind, content in found.items()}


def tum() -> Files:
    listing = "# timestamp filename\n" + "".join(f"{1000 + i / 10:.6f} rgb/{i}.png\n" for i in range(4))
    poses = "# timestamp tx ty tz qx qy qz qw\n" + trajectory_text(7)
    return pictures([f"rgb/{index}.png" for index in range(4)]) | {
        "rgb.txt": listing.encode(),
        "groundtruth.txt": poses.encode(),
        "calibration.txt": b"60 61 31.5 23.5 -0.1 0.01 0.001 0.002\n",
    }


def trajectory_text(poses: int) -> str:
    return "".join(f"{1000 + i / 20:.6f} {i / 20} 0.1 -2e-3 0 0 0.6 0.8\n" for i in range(poses))


def euroc() -> Files:
    times = [1403636579763555584 + 50_000_000 * index for index in range(3)]
    rows = [f"{time + 1000},{index},0,0,1,0,0,0,9,9,9,9,9,9,9,9,9\n" for index, time in enumerate(times)]
    listing = "#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\r\n" for t in times)
    return pictures([f"mav0/cam0/data/{time}.png" for time in times]) | {
        "mav0/cam0/data.csv": listing.encode(),
        "mav0/cam0/sensor.yaml": SENSOR.encode(),
        "mav0/state_groundtruth_estimate0/data.csv": ("#timestamp\n" + "".join(rows)).encode(),
    }


def imu() -> Files:
    rows = "".join(f"{1000 + i / 200:.4f},0.1,-2e-3,0.3,0.2,9.8,-0.1\n" for i in range(6))
    names = [f"gyro_{axis} [rad/s]" for axis in "xyz"] + [f"acc_{axis} [m/s^2]" for axis in "xyz"]
    return {
        "imu.csv": (",".join(["time [s]", *names]) + "\n" + rows).encode(),
        "camera.yaml": SENSOR.encode(),
        "imu.yaml": b"gyroscope_noise_density: 1.7e-4\naccelerometer_noise_density: 2e-3\n",
    }


def kitti() -> Files:
    return pictures([f"image_0/{index:06d}.png" for index in range(3)]) | {
        "times.txt": b"0.000000e+00\n1.037430e-01\n2.074860e-01\n",
        "calib.txt": b"P0: 70 0 31 0 0 71 23 0 0 0 1 0\nP2: 70 0 31 4.2 0 71 23 0 0 0 1 0\n",
        "poses.txt": b"1 0 0 0 0 1 0 0 0 0 1 0\n0 0 1 5 0 1 0 0 -1 0 0 0\n1 0 0 0 0 1 0 0 0 0 1 2\n",
    }


def kitti_raw() -> Files:
    times = "".join(f"2011-09-26 13:02:25.{100_000_000 + i * 103_000_001:09d}\n" for i in range(3)).encode()
    packets = {
        f"drive_sync/oxts/data/{index:010d}.txt": f"{49 + index * 1e-5} 8.4 100 0.1 0 1.57 0 0 0\n".encode()
        for index in range(3)
    }
    images = pictures([f"drive_sync/image_00/data/{index:010d}.png" for index in range(3)])
    return (
        images
        | packets
        | {
            "drive_sync/image_00/timestamps.txt": times,
            "drive_sync/oxts/timestamps.txt": times,
            "calib_cam_to_cam.txt": CAM_TO_CAM.encode(),
            "calib_velo_to_cam.txt": b"calib_time: x\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0.5\n",
            "calib_imu_to_velo.txt": b"calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n",
        }
    )


def depth_images() -> Files:
    """TUM's list, of images of 16 bits."""
    names = [f"depth/{index}.png" for index in range(3)]
    listing = "# timestamp filename\n" + "".join(f"{1000 + i / 10:.6f} {n}\n" for i, n in enumerate(names))
    values = {name: encoded(20 * picture(index).astype(np.uint16)) for index, name in enumerate(names)}
    return values | {"depth.txt": listing.encode()}


def seven_scenes() -> Files:
    poses = {f"frame-{i:06d}.pose.txt": f"1 0 0 {i}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n".encode() for i in range(3)}
    return pictures([f"frame-{index:06d}.color.png" for index in range(3)]) | poses


def tartanair() -> Files:
    return pictures([f"image_left/{index:06d}_left.png" for index in range(3)]) | {
        "pose_left.txt": b"0 0 0 0 0 0 1\n3 2 1 0 0 0.6 0.8\n3 2 1.5 0 0 0.6 0.8\n"
    }


def icl_nuim() -> Files:
    return pictures([f"rgb/{index}.png" for index in (1, 2, 10)]) | {
        "livingRoom0.gt.freiburg": b"1 0.1 0.2 0.3 0 0 0 1\n10 1 2 3 0.6 0 0 0.8\n11 0 0 0 0 0 0 1\n"
    }


@cache
def positions() -> dict[str, Files]:
    """Positions in every layout."""
    table = "time,latitude,longitude,altitude,std_horizontal\n0,48.1,11.5,520,1.5\n1,48.2,11.5,,\n2,,,,\n"
    found = {
        "csv": {"a.csv": table.encode()},
        "gpx": {"a.gpx": GPX.encode()},
        "nmea": {"a.nmea": with_sums(NMEA).encode()},
        "oxts": {f"oxts/{name.split('oxts/')[1]}": c for name, c in kitti_raw().items() if "oxts/" in name},
        "exif": {"a.jpg": _with_position()},
    }
    layouts = {"brackets": MAVIC_3, "tuple": MAVIC_PRO, "mini": MINI_2}
    return found | {f"srt {name}": {"a.srt": text.encode()} for name, text in layouts.items()}


def _with_position() -> bytes:
    image, content = Image.fromarray(picture(1)), io.BytesIO()
    exif = image.getexif()
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 6.0, 1.5), 3: "E", 4: (11.0, 30.0, 0.0), 6: 520.5})
    image.save(content, "JPEG", exif=exif)
    return content.getvalue()


def folder() -> Files:
    names = ["images/1.png", "images/2.jpg", "images/10.png", "images/mask.png"]
    return pictures(names) | {"calibration.txt": b"60 61 31.5 23.5\n"}


def masked() -> Files:
    frames = pictures([f"frames/{index}.png" for index in range(3)])
    masks = {f"masks/{index}.png": encoded(np.full(SIZE[::-1], 255, np.uint8)) for index in range(2)}
    return masks | {name: frames[name] for name in frames}


def packed(files: Files) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def zipped() -> Files:
    return {"desk.zip": packed({f"desk/{name}": content for name, content in tum().items()})}


def zipped_video() -> Files:
    return {"v.zip": packed({"v.mp4": videos()["mp4"]["v.mp4"], "__MACOSX/._v.mp4": b"x"})}


@cache
def videos() -> dict[str, Files]:
    found = {}
    frames = [np.stack([picture(index)] * 3, axis=-1) for index in range(5)]
    with tempfile.TemporaryDirectory() as name:
        write_mp4(Path(name) / "v.mp4", frames)
        writer = cv2.VideoWriter(f"{name}/v.avi", cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE)
        for frame in frames:
            writer.write(frame)
        writer.release()
        for suffix in ("mp4", "avi"):
            found[suffix] = {f"v.{suffix}": (Path(name) / f"v.{suffix}").read_bytes()}
    return found


@cache
def bags() -> dict[str, Files]:
    found = {}
    with tempfile.TemporaryDirectory() as name:
        for kind in ("ros1", "sqlite3", "mcap"):
            target = Path(name) / kind / ("r.bag" if kind == "ros1" else "r")
            target.parent.mkdir()
            recording = Recording(target, kind)
            recording.camera_info("/cam0/camera_info")
            for index, stamp in enumerate(STAMPS):
                recording.image("/cam0/image_raw", picture(index), stamp)
            recording.close()
            found[kind] = content_of(target.parent)
    return found


CALIBRATIONS: dict[str, Files] = {
    "opencv.yaml": {"c.yaml": OPENCV.encode()},
    "opencv.xml": {
        "c.xml": b'<?xml version="1.0"?>\n<opencv_storage>\n<image_width>64</image_width>\n'
        b'<image_height>48</image_height>\n<camera_matrix type_id="opencv-matrix">\n<rows>3</rows>\n<cols>3</cols>\n'
        b"<dt>d</dt>\n<data>\n60. 0. 31.5 0. 61. 23.5 0. 0. 1.</data></camera_matrix>\n"
        b'<distortion_coefficients type_id="opencv-matrix"><data>-0.1 0.01 0. 0. 0.</data></distortion_coefficients>\n'
        b"</opencv_storage>\n"
    },
    "ros.yaml": {"c.yaml": ROS.encode()},
    "kalibr.yaml": {"c.yaml": KALIBR.replace("radtan", "equidistant").encode()},
    "euroc.yaml": {"c.yaml": SENSOR.encode()},
    "orb.yaml": {"c.yaml": ORB_SLAM.replace("PinHole", "KannalaBrandt8").replace("p1", "k3").encode()},
    "pyyaml.yaml": {"c.yaml": PYYAML.encode()},
    "stella.yaml": {"c.yaml": STELLA.encode()},
    "vins.yaml": {"c.yaml": VINS.encode()},
    "lists.json": {"c.json": LISTED.encode()},
    "colmap.txt": {"c.txt": COLMAP.encode()},
    "transforms.json": {"c.json": NERFSTUDIO.encode()},
    "numbers": {
        "c.txt": b"# fx fy cx cy\n600 610 319.5 239.5\n",
        "distortion.txt": b"-0.1 0.01 0.001 0.002\n",
    },
    "fisheye": {"c.txt": b"fisheye 600 610 319.5 239.5 0.01 0 0 0\n"},
}
"""Calibration files of every program whose files are read; the first of each is what is opened."""

BATCH_CSV = (
    "sequence,name,camera,config,overrides,groundtruth,start,stop,stride,fps,limit,resize,mask\n"
    'a/rgb,first,"60,61,31.5,23.5",c.toml,seed=3; features.num_keypoints=500,t.txt,1.5s,1:30,2,12.5,9,0.5,m.png\n'
    '"b, c",,fov=65,,,,0,7,,,,48x36,\n'
    "synthetic:room?frames=3,,,,seed=7,,,,,,,,\n"
)
BATCH_TEXT = "# three\na/rgb\n../b.mp4  # a video\nsynthetic:room?frames=3\n"

CAMERA_ARGUMENTS = [
    "60,61,31.5,23.5",
    "fisheye,60,61,31.5,23.5,0,0,0,0",
    "fov=65",
    "f=0.8w",
    "tum-fr1",
    "exif",
    "auto",
]
FRAME_ARGUMENTS = [
    "start=1",
    "start=0.1s",
    "stop=1:30",
    "fps=10",
    "resize=48x36",
    "resize=0.75",
    "stride=2",
    "limit=2",
]
OVERRIDES = [
    *("features.num_keypoints=2000", "keyframes.max_rotation_deg=12.5", "seed=7"),
    'features.weights="a.safetensors"',
]
ABSURD = [0, 1, 2, -1, 1e-300, 1e-9, 1e-3, 0.5, 1e3, 1e4, 1e6, 1e12, 1e300]


def extreme_setting(rng: random.Random) -> str:
    """A setting with a number that is finite, often allowed, and never meant."""
    numbers = [line for line in to_toml(Config()).splitlines() if "=" in line or line.startswith("[")]
    section, names = "", []
    for line in numbers:
        if line.startswith("["):
            section = line.strip("[]") + "."
        elif line.partition(" = ")[2][0] in "0123456789":
            names.append(section + line.partition(" = ")[0])
    return f"{rng.choice(names)}={rng.choice(ABSURD)!r}"
