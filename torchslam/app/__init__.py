"""Open a page in the browser: drop a video, watch the map grow, measure, and take the result away.

The folder keeps what was uploaded and the results, one folder for each run; other recordings in it are offered on the
page. Each run is a process of its own, `torchslam run`, which goes on when the page or the server is closed.

By default the page is for this computer alone, also through a tunnel: ssh -L 8090:localhost:8090 COMPUTER. For another
--host, the address that is printed contains a token. Needs Linux or macOS, and the extra `app`.
"""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path

from torchslam.cli.arguments import at_least
from torchslam.errors import ConfigError

PORT = 8090  # of the page; neither 8080 of other viewers nor 8888 of notebooks
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30}  # of sizes on the command line, bytes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam app`."""
    folder = "folder of results, created if needed (default: %(default)s)"
    parser.add_argument(
        "folder", type=Path, nargs="?", default=Path("results"), metavar="FOLDER", help=folder
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen at (default: this computer alone)"
    )
    port = "port; 0: any free one (default: %(default)s)"
    parser.add_argument("--port", type=at_least(0), default=PORT, metavar="N", help=port)
    parser.add_argument("--no-browser", action="store_true", help="do not open the browser")
    upload = "largest upload, for example 500M (default: 4G)"
    parser.add_argument("--max-upload", type=size, default=size("4G"), metavar="SIZE", help=upload)
    most = "number of runs in the folder from which on no more are accepted (default: %(default)s)"
    parser.add_argument("--max-runs", type=at_least(1), default=100, metavar="N", help=most)


def size(text: str) -> int:
    """Parse a size in bytes, such as 4G."""
    found = re.fullmatch(r"(\d{1,12})([KMG]?)B?", text.strip().upper())
    if found is None or not int(found[1]):
        raise argparse.ArgumentTypeError(f"{text!r}: write a size such as 500M or 4G")
    return int(found[1]) * UNITS[found[2]]


def execute(options: argparse.Namespace) -> int:
    """Execute `torchslam app`; returns the exit status."""
    if os.name == "nt":
        raise ConfigError("torchslam app needs Linux or macOS: its runs are known by their locks")
    from torchslam.app.server import serve

    return serve(options)
