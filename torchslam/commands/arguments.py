"""Arguments that several commands share, and what they say about sequence and configuration."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from torchslam.config import CHOICES, Config, load_config
from torchslam.data import Sequence, open_sequence

SEQUENCE_HELP = "ETH3D, TUM, KITTI or EuRoC folder, folder of images, video file, or synthetic:room"


def add_sequence(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", help=SEQUENCE_HELP)
    parser.add_argument(
        "--camera",
        metavar="FX,FY,CX,CY[,K1,K2,P1,P2,K3]|FILE",
        help="calibration in pixels; needed for image folders and videos, replaces the one found elsewhere",
    )
    parser.add_argument("--limit", type=_positive, metavar="N", help="read only the first N frames")


def sequence(options: argparse.Namespace) -> Sequence:
    """The sequence that the arguments of `add_sequence` name."""
    return open_sequence(options.path, options.camera, limit=options.limit)


def add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="TOML file of settings; the rest are defaults"
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change one setting, for example features.num_keypoints=2000; may be repeated",
    )
    parser.add_argument("--features", choices=CHOICES["features.kind"], help="front end (features.kind)")
    parser.add_argument("--weights", metavar="FILE", help="weights of a learned front end (features.weights)")
    parser.add_argument("--scale", choices=CHOICES["scale"], help="length of a map unit (scale)")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of all random choices (seed)")


def config(options: argparse.Namespace) -> Config:
    """The configuration that the arguments of `add_config` name: the file, then --set, then the other options."""
    named = {
        "features.kind": options.features,
        "features.weights": options.weights,
        "scale": options.scale,
        "seed": options.seed,
    }
    own = [f"{key}={value}" for key, value in named.items() if value is not None]
    return load_config(options.config, [*options.overrides, *own])


def add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device",
        type=_device,
        default=torch.device("cpu"),
        metavar="DEVICE",
        help="where to compute, for example cuda (default: %(default)s)",
    )


def _device(text: str) -> torch.device:
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


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {number}")
    return number
