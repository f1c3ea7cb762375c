"""Command-line arguments shared by several commands.

torch is imported only where a sequence is opened or a device is named, so that the help appears at once.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from torchslam.config import CHOICES, Config, MetricConfig, builtin_names, load_config
from torchslam.config.schema import descriptions
from torchslam.errors import ConfigError
from torchslam.metric.options import KINDS, given_options, setting_of, sources_of
from torchslam.utils.console import say

if TYPE_CHECKING:
    import torch

    from torchslam.data import Sequence
    from torchslam.data.calibration import Calibration
    from torchslam.metric.source import MetricSource

SEQUENCE_HELP = (
    "folder (ETH3D, TUM, KITTI, KITTI raw, EuRoC, 7-Scenes, TartanAir, ICL-NUIM, or images), pattern of images, "
    "video, zip, ROS bag (.bag, .mcap, folder), camera number, rtsp:// address, or synthetic:room"
)
PRESETS = "tum-fr1, tum-fr2, tum-fr3, euroc, kitti, 7-scenes, tartanair, icl"
"""The names in `torchslam.data.calibration`, which needs torch."""
AUTO = "auto"
"""The readout of a rolling shutter that is to be found."""
READOUTS_MS = {"kinect": 30.0}
"""Readouts by name, milliseconds: that of the Kinect's color camera at 30 frames a second."""
METRIC_OPTIONS = [option for kind in KINDS for option in kind.options]
GIVEN_READOUT_STD_MS = 1.0
"""Standard deviation of a readout that is given, milliseconds. Tried at this value only."""


def add_sequence(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for the sequence, its camera and the selection of frames."""
    parser.add_argument("path", metavar="PATH", help=SEQUENCE_HELP)
    add_reading(parser)


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for the camera and the selection of frames."""
    parser.add_argument(
        "--camera",
        metavar="CAMERA",
        help="FX,FY,CX,CY[,K1,K2,P1,P2,K3] in pixels; a calibration file (OpenCV, ROS, Kalibr, ORB-SLAM3, COLMAP, "
        f"nerfstudio); a preset ({PRESETS}); a guess to refine: fov=65 (degrees), f=0.8w (image widths), exif; or "
        "auto. Overrides the calibration of the sequence",
    )
    reading = parser.add_argument_group("frame selection")
    reading.add_argument("--start", default=0, metavar="N|TIME", help="first frame: 120, 12.5s or 1:30")
    reading.add_argument("--stop", metavar="N|TIME", help="end before this frame: 240, 20s or 2:00")
    reading.add_argument("--stride", type=at_least(1), default=1, metavar="N", help="use every N-th frame")
    reading.add_argument(
        "--fps",
        type=float,
        metavar="RATE",
        help="use at most RATE frames per second; also the frame rate of images without timestamps (default: 30)",
    )
    reading.add_argument(
        "--limit", type=at_least(1), metavar="N", help="use only the first N of these frames"
    )
    reading.add_argument(
        "--resize",
        metavar="WxH|W|FACTOR",
        help="resize the images and adapt the camera: 640x480, 640 (width) or 0.5",
    )
    reading.add_argument(
        "--mask",
        metavar="FILE|DIR",
        help="mask image, black where no features are wanted; or a folder with one mask per frame",
    )


def add_output(
    parser: argparse.ArgumentParser, content: str = "the results", default: Path | None = None
) -> None:
    """Add the argument for the folder that a command writes."""
    about = f"folder for {content}" + ("" if default is None else " (default: %(default)s)")
    needed = default is None
    parser.add_argument(
        "--output", "-o", type=Path, required=needed, default=default, metavar="DIR", help=about
    )


def add_directory(parser: argparse.ArgumentParser) -> None:
    """Add the argument for a folder of results."""
    parser.add_argument("directory", type=Path, metavar="DIR", help="folder that `torchslam run` wrote")


def add_images(parser: argparse.ArgumentParser) -> None:
    """Add the argument for the location of a run's images."""
    about = "the images of the run, if they are not where the run read them"
    parser.add_argument("--images", metavar="PATH", help=about)


def sequence(options: argparse.Namespace, camera: Calibration | None = None) -> Sequence:
    """Open the sequence of the arguments of `add_sequence`, with `camera` if the user gives none; say its notes."""
    from torchslam.data import open_sequence

    found = open_sequence(
        options.path,
        camera if options.camera is None else options.camera,
        fps=options.fps,
        limit=options.limit,
        stride=options.stride,
        start=options.start,
        stop=options.stop,
        resize_to=options.resize,
        mask=options.mask,
    )
    for note in found.notes:
        say(f"{found.name}: {note}")
    return found


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for the configuration."""
    add_settings(parser)
    add_named_settings(parser)


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for a file of settings and for single ones."""
    parser.add_argument(
        "--config",
        metavar="FILE|NAME",
        help=f"TOML file of settings, or a built-in configuration: {', '.join(builtin_names())}",
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change one setting, for example features.num_keypoints=2000; can be repeated",
    )


def add_named_settings(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the settings that have an option of their own, in groups; return the group of the camera."""
    features = parser.add_argument_group("features")
    features.add_argument(
        "--features",
        metavar="NAME",
        help=f"feature extractor (features.kind): {', '.join(CHOICES['features.kind'])}, kornia:NAME, "
        "a plugin, or PACKAGE:NAME",
    )
    features.add_argument(
        "--weights",
        metavar="FILE|NAME",
        help="weights of a learned feature extractor (features.weights); by default those with its name",
    )
    features.add_argument(
        "--matcher",
        metavar="NAME",
        help="matcher (matching.matcher): descriptors, lightglue, kornia:NAME, a plugin, or PACKAGE:NAME",
    )
    features.add_argument(
        "--motion-model",
        metavar="NAME",
        help=f"predicts poses (tracking.motion_model): {', '.join(CHOICES['tracking.motion_model'])}, a plugin, or "
        "PACKAGE:NAME",
    )
    camera = parser.add_argument_group("error of the given camera")
    camera.add_argument(
        "--camera-std",
        type=float,
        metavar="RATIO",
        help="relative standard deviation of the given focal length (camera.std): 0.02 if neither this nor the "
        "calibration file states it; 0: the camera is exact",
    )
    camera.add_argument(
        "--readout",
        type=_readout,
        default=AUTO,
        metavar="MS",
        help="time from the exposure of the first row of an image to the last (camera.readout): milliseconds, "
        f"{', '.join(READOUTS_MS)}, 0 for a global shutter, or auto, the default: estimated from the images",
    )
    others = parser.add_argument_group("other settings")
    others.add_argument("--scale", choices=CHOICES["scale"], help="length unit of the map (scale)")
    others.add_argument("--seed", type=int, metavar="N", help="seed of the random number generators (seed)")
    return camera


def config(options: argparse.Namespace) -> Config:
    """Load the configuration given by the arguments of `add_config`: the file, then --set, then the other options."""
    return load_config(options.config, overrides(options))


def overrides(options: argparse.Namespace) -> list[str]:
    """Return the changes that the arguments of `add_config` make to the file, as `section.key=value`."""
    named = {"features.kind": options.features, "features.weights": options.weights}
    named |= {"tracking.motion_model": options.motion_model}
    named |= {"matching.matcher": options.matcher, "camera.std": options.camera_std}
    named |= {"scale": options.scale, "seed": options.seed}
    if options.readout != AUTO:
        named["camera.readout"] = options.readout
        named["camera.readout_std"] = GIVEN_READOUT_STD_MS if options.readout else 0.0
    given = [f"{key}={value}" for key, value in named.items() if value is not None]
    return [*options.overrides, *given, *metric_overrides(options)]


def add_metric(parser: argparse.ArgumentParser) -> None:
    """Add the options that give the map meters: those of `metric.options.KINDS`."""
    group = parser.add_argument_group("meters", "measurements that determine the scale; each can be repeated")
    about = descriptions(MetricConfig)
    for option in METRIC_OPTIONS:
        words = about[option.name].replace("%", "%%")
        group.add_argument(
            option.flag,
            dest=f"metric_{option.name}",
            action="append",
            nargs=len(option.words),
            metavar=option.words,
            help=f"{words[0].lower()}{words[1:].rstrip('.')} (metric.{option.name})",
        )


def metric_overrides(options: argparse.Namespace) -> list[str]:
    """Return the changes that the arguments of `add_metric` make to the configuration, as `section.key=value`."""
    numbers = {each.name for each in fields(MetricConfig) if isinstance(each.default, float)}
    changes = []
    for option in METRIC_OPTIONS:
        times = getattr(options, f"metric_{option.name}", None)
        if times and option.name in numbers:
            changes.append(f"metric.{option.name}={_given_once(option.flag, times)!r}")
        elif times:
            changes.append(f"metric.{option.name}={json.dumps(setting_of(times), ensure_ascii=False)}")
    return changes


def metric_sources(config: MetricConfig, sequence: Sequence) -> list[MetricSource]:
    """Make the sources that measure the unit of a sequence's map. Raises TorchslamError for a wrong option or file."""
    from torchslam.metric.distances import Distances

    sources = sources_of(given_options(config, sequence.measurements))
    for each in sources:
        if isinstance(each, Distances):
            each.check(sequence.size)
    return sources


def _given_once(flag: str, times: list[list[str]]) -> float:
    """Return the positive number of an option; 0 would be the setting of an option that is not given."""
    if len(times) > 1:
        raise ConfigError(f"{flag} is given {len(times)} times: one number is needed")
    try:
        value = float(times[0][0])
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise ConfigError(f"{flag} {times[0][0]}: write a number above 0, without a unit")
    return value


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the argument for the device."""
    parser.add_argument(
        "--device",
        type=_device,
        default="cpu",  # a string: a device would need torch
        metavar="DEVICE",
        help="device to compute on, for example cuda (default: %(default)s)",
    )


def add_processes(parser: argparse._ActionsContainer) -> None:
    """Add the argument for the number of processes."""
    parser.add_argument(
        "--processes",
        type=at_least(1),
        metavar="N",
        help="number of processes: 2 adds a feature prefetcher, 3 also a bundle-adjustment worker; windows of a long "
        "recording are mapped in as many; results are identical (default: 3 if two processors are free and there are "
        "enough frames, else 1; for windows one per free processor)",
    )


def _device(text: str) -> torch.device:
    import torch

    try:
        device = torch.device(text)
        torch.zeros(1, device=device, dtype=torch.float32).item()  # "meta" only pretends to compute
    except (RuntimeError, AssertionError) as error:  # the latter from a torch without CUDA
        reason = str(error).splitlines()[0]
        raise argparse.ArgumentTypeError(f"{text!r} cannot be used here: {reason}") from None
    return device


def _readout(text: str) -> float | str:
    """Parse a readout in milliseconds, a name of one, or `AUTO`."""
    if text == AUTO:
        return text
    try:
        return READOUTS_MS[text] if text in READOUTS_MS else float(text)
    except ValueError:
        known = ", ".join((AUTO, *READOUTS_MS))
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor one of {known}") from None


def at_least(lowest: int) -> Callable[[str], int]:
    """Return a parser of an integer argument that is not below the lowest one."""

    def integer(text: str) -> int:
        number = int(text)
        if number < lowest:
            raise argparse.ArgumentTypeError(f"must be at least {lowest}, not {number}")
        return number

    return integer
