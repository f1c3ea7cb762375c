"""Run SLAM on a sequence and write trajectory, map, figures and pictures.

Exit status: 0 done, 2 an error, 3 no map could be initialised, 130 interrupted (what there is by then is written).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from torchslam.commands import arguments
from torchslam.commands.progress import ProgressBar
from torchslam.config import Config
from torchslam.data import Sequence
from torchslam.errors import TrajectoryError
from torchslam.evaluation import Evaluation, evaluate
from torchslam.output.pictures import draw
from torchslam.output.report import metrics, summary, table
from torchslam.output.results import read_results, write_results
from torchslam.run import Run
from torchslam.slam import SLAM

DONE = 0
NO_MAP = 3
INTERRUPTED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    arguments.add_sequence(parser)
    parser.add_argument(
        "--output", "-o", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    arguments.add_device(parser)
    arguments.add_config(parser)


def execute(options: argparse.Namespace) -> int:
    return run(arguments.sequence(options), arguments.config(options), options.output, options.device)


def run(sequence: Sequence, config: Config, output: Path, device: torch.device) -> int:
    """Run, evaluate, write, draw, report; returns the exit status."""
    output.mkdir(parents=True, exist_ok=True)  # better now than after an hour's run
    slam = SLAM(sequence.camera.to(device), config)
    with ProgressBar(len(sequence), lambda: slam.map.num_points) as progress:
        finished = slam.run(sequence, progress.update)
    figures = metrics(finished, _evaluate(finished, sequence))
    write_results(finished, sequence, figures, output)
    draw(read_results(output), output)
    print(f"\n{sequence.name}\n{table(summary(figures) | {'results': str(output)})}")
    if finished.interrupted:
        print("torchslam: interrupted; the results up to here are written", file=sys.stderr)
        return INTERRUPTED
    if finished.failure:
        print(f"torchslam: {finished.failure}", file=sys.stderr)
        return NO_MAP
    return DONE


def _evaluate(finished: Run, sequence: Sequence) -> Evaluation | None:
    """The errors against ground truth, where there is one and the run has poses to compare."""
    if sequence.groundtruth is None or finished.failure:
        return None
    try:
        return evaluate(finished.trajectory, sequence.groundtruth)
    except TrajectoryError as error:
        print(f"torchslam: warning: no evaluation: {error}", file=sys.stderr)
        return None
