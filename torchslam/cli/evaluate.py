"""Compare two trajectories in TUM format: absolute and relative errors."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from torchslam.data.trajectories import read_trajectory
from torchslam.evaluation import evaluate
from torchslam.io.report import accuracy
from torchslam.io.results import TRAJECTORY
from torchslam.utils.console import table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "estimate",
        type=Path,
        metavar="ESTIMATE",
        help="estimated trajectory, or folder that `torchslam run` wrote",
    )
    parser.add_argument("groundtruth", type=Path, metavar="GROUNDTRUTH", help="true trajectory")
    parser.add_argument("--json", action="store_true", help="print all figures as JSON instead of a table")


def execute(options: argparse.Namespace) -> int:
    results: Path = options.estimate
    estimate = read_trajectory(results / TRAJECTORY if results.is_dir() else results)
    groundtruth = read_trajectory(options.groundtruth)
    metrics = evaluate(estimate, groundtruth).as_dict()
    print(json.dumps(metrics, indent=2) if options.json else table(accuracy(metrics)))
    return 0
