"""Redraw the plots and view.html of a run from its results folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchslam.io.pictures import draw
from torchslam.io.results import read_results
from torchslam.io.viewer.page import write_view


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("directory", type=Path, metavar="DIR", help="folder that `torchslam run` wrote")


def execute(options: argparse.Namespace) -> int:
    results = read_results(options.directory)
    for path in [*draw(results, options.directory), write_view(results, options.directory)]:
        print(path)
    return 0
