"""Fetch a public sequence: with a progress bar, taking up a transfer that broke off."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchslam.data.download import ETH3D_URL, download


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="eth3d/SEQUENCE, for example eth3d/plant_1")
    parser.add_argument(
        "--to",
        type=Path,
        default=Path("data"),
        metavar="DIR",
        help="where its folder goes; default: %(default)s",
    )
    parser.add_argument("--sha256", metavar="HEX", help="checksum of the archive: another one is deleted")
    parser.add_argument("--url", default=ETH3D_URL, help="server that has the archives; default: %(default)s")


def execute(options: argparse.Namespace) -> int:
    print(download(options.name, options.to, options.url, sha256=options.sha256))
    return 0
