"""Run SLAM on a rendered room, evaluate and plot it: the whole system without any data."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchslam.cli import arguments
from torchslam.cli.run import Plan, run
from torchslam.data import open_sequence

SEQUENCE = "synthetic:room"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--output",
        "-o",
        type=Path,
        default=Path("results/demo"),
        metavar="DIR",
        help="folder for the results (default: %(default)s)",
    )
    arguments.add_device(parser)
    arguments.add_config(parser)


def execute(options: argparse.Namespace) -> int:
    # The results can be reproduced, so overwriting loses nothing.
    plan = Plan(SEQUENCE, options.output, options.device, overwrite=True)
    return run(open_sequence(SEQUENCE), arguments.config(options), plan)
