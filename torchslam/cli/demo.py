"""Render a room, run SLAM on it, evaluate and draw: the system in one command, without any data."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchslam.cli import arguments
from torchslam.cli.run import Plan, run
from torchslam.data import open_sequence

SEQUENCE = "synthetic:room"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--output", "-o", type=Path, default=Path("results/demo"), metavar="DIR", help="default: %(default)s"
    )
    arguments.add_device(parser)
    arguments.add_config(parser)


def execute(options: argparse.Namespace) -> int:
    plan = Plan(
        SEQUENCE, options.output, options.device, overwrite=True
    )  # the same room again: nobody's work is lost
    return run(open_sequence(SEQUENCE), arguments.config(options), plan)
