"""Print every setting with what it is, its range and its default, as TOML that --config reads.

With --config and --set it prints what a run with them would use.
"""

from __future__ import annotations

import argparse

from torchslam.cli import arguments
from torchslam.config.schema import explained


def add_arguments(parser: argparse.ArgumentParser) -> None:
    arguments.add_config(parser)


def execute(options: argparse.Namespace) -> int:
    print(explained(arguments.config(options)), end="")
    return 0
