"""Print every setting with its description, range and default, as TOML for --config.

With --config and --set, the values that a run would use are printed.
"""

from __future__ import annotations

import argparse

from torchslam.cli import arguments
from torchslam.config.schema import to_commented_toml


def add_arguments(parser: argparse.ArgumentParser) -> None:
    arguments.add_config(parser)


def execute(options: argparse.Namespace) -> int:
    print(to_commented_toml(arguments.config(options)), end="")
    return 0
