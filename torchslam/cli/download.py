"""Download a public sequence; an interrupted transfer is resumed."""

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
        help="folder to place the sequence in (default: %(default)s)",
    )
    parser.add_argument("--sha256", metavar="HEX", help="expected checksum; another archive is deleted")
    parser.add_argument("--url", default=ETH3D_URL, help="server of the archives (default: %(default)s)")


def execute(options: argparse.Namespace) -> int:
    print(download(options.name, options.to, options.url, sha256=options.sha256))
    return 0
