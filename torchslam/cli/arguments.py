"""Arguments that several commands share, and what they say about sequence and configuration.

torch is imported where a sequence is opened or a device is named: the help needs neither.
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from torchslam.config import CHOICES, Config, load_config
from torchslam.config.builtin import names

if TYPE_CHECKING:
    import torch

    from torchslam.data import Sequence

SEQUENCE_HELP = (
    "folder (ETH3D, TUM, KITTI, KITTI raw, EuRoC, 7-Scenes, TartanAir, ICL-NUIM, or images), pattern of images, "
    "video, zip, ROS bag (.bag, .mcap, folder), camera number, rtsp:// address, or synthetic:room"
)
PRESETS = "tum-fr1, tum-fr2, tum-fr3, euroc, kitti, 7-scenes, tartanair, icl"
"""The names in `torchslam.data.presets`, which needs torch."""


def add_sequence(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", help=SEQUENCE_HELP)
    add_reading(parser)


def add_reading(parser: argparse.ArgumentParser) -> None:
    """With which camera a sequence is read, and which of its frames."""
    parser.add_argument(
        "--camera",
        metavar="CAMERA",
        help="FX,FY,CX,CY[,K1,K2,P1,P2,K3] in pixels; a calibration file (OpenCV, ROS, Kalibr, ORB-SLAM3, COLMAP, "
        f"nerfstudio); a preset ({PRESETS}); a guess that the images improve: fov=65 (degrees), "
        "f=0.8w (image widths), exif; or auto: the images decide. Replaces the calibration found with the images",
    )
    reading = parser.add_argument_group("which frames, and how")
    reading.add_argument("--start", default=0, metavar="N|TIME", help="first frame: 120, 12.5s or 1:30")
    reading.add_argument("--stop", metavar="N|TIME", help="end before this frame: 240, 20s or 2:00")
    reading.add_argument("--stride", type=positive, default=1, metavar="N", help="take every N-th frame")
    reading.add_argument(
        "--fps",
        type=float,
        metavar="RATE",
        help="take at most RATE frames per second; images without times are taken to be RATE a second (else 30)",
    )
    reading.add_argument("--limit", type=positive, metavar="N", help="take only the first N of these frames")
    reading.add_argument(
        "--resize", metavar="WxH|W|FACTOR", help="640x480, 640 or 0.5: the images, and the camera with them"
    )
    reading.add_argument(
        "--mask",
        metavar="FILE|DIR",
        help="image of the size of the frames, black where no features are wanted; or a folder with one per frame",
    )


def sequence(options: argparse.Namespace) -> Sequence:
    """The sequence that the arguments of `add_sequence` name; what is to know about it goes to stderr."""
    from torchslam.data import open_sequence

    found = open_sequence(
        options.path,
        options.camera,
        fps=options.fps,
        limit=options.limit,
        stride=options.stride,
        start=options.start,
        stop=options.stop,
        resize_to=options.resize,
        mask=options.mask,
    )
    for note in found.notes:
        print(f"torchslam: {found.name}: {note}", file=sys.stderr)
    return found


def add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--config",
        metavar="FILE|NAME",
        help=f"TOML file of settings, or one that comes with torchslam: {', '.join(names())}; the rest are defaults",
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change one setting, for example features.num_keypoints=2000; may be repeated",
    )
    parser.add_argument(
        "--features",
        metavar="NAME",
        help=f"front end (features.kind): {', '.join(CHOICES['features.kind'])}, a registered name, or PACKAGE:NAME",
    )
    parser.add_argument("--weights", metavar="FILE", help="weights of a learned front end (features.weights)")
    parser.add_argument(
        "--matcher",
        metavar="NAME",
        help="matcher (matching.matcher): descriptors, a registered name, or PACKAGE:NAME",
    )
    parser.add_argument("--scale", choices=CHOICES["scale"], help="length of a map unit (scale)")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of all random choices (seed)")


def config(options: argparse.Namespace) -> Config:
    """The configuration that the arguments of `add_config` name: the file, then --set, then the other options."""
    return load_config(options.config, overrides(options))


def overrides(options: argparse.Namespace) -> list[str]:
    """What the arguments of `add_config` change in the file, as `section.key=value`."""
    named = {
        "features.kind": options.features,
        "features.weights": options.weights,
        "matching.matcher": options.matcher,
        "scale": options.scale,
        "seed": options.seed,
    }
    return [*options.overrides, *(f"{key}={value}" for key, value in named.items() if value is not None)]


def add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device",
        type=_device,
        default="cpu",  # a word: a device would need torch
        metavar="DEVICE",
        help="where to compute, for example cuda (default: %(default)s)",
    )


def add_processes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--processes",
        type=positive,
        metavar="N",
        help="number of processes: 2 adds a feature prefetcher, 3 also a bundle-adjustment worker; results are "
        "identical (default: 3 if there are two processors and enough frames, else 1)",
    )


def _device(text: str) -> torch.device:
    import torch

    try:
        device = torch.device(text)
        torch.zeros(1, device=device).item()  # "meta" only pretends to compute
    except (RuntimeError, AssertionError) as error:  # the latter from a torch without CUDA
        reason = str(error).splitlines()[0]
        raise argparse.ArgumentTypeError(f"{text!r} cannot be used here: {reason}") from None
    return device


def not_negative(text: str) -> int:
    """A number from 0 on, of an argument."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"must be at least 0, not {number}")
    return number


def positive(text: str) -> int:
    """A number from 1 on, of an argument."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {number}")
    return number
