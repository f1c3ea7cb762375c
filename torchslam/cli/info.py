"""Describe a sequence: frames, size, rate, calibration, ground truth."""

from __future__ import annotations

import argparse

from torchslam.cli import arguments
from torchslam.utils.console import table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    arguments.add_sequence(parser)


def execute(options: argparse.Namespace) -> int:
    print(table(arguments.sequence(options).describe()))
    return 0
