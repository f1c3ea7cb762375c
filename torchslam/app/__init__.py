"""Open a page in the browser: drop a video, watch the map grow, measure, and take the result away.

The folder keeps what was uploaded and the results, one folder for each run; other recordings in it are offered on the
page. Each run is a process of its own, `torchslam run`, which goes on when the page or the server is closed.

By default the page is for this computer alone, also through a tunnel: ssh -L 8090:localhost:8090 COMPUTER. For another
--host, the address that is printed contains a token. Needs Linux or macOS, and the extra `app`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import secrets
import socket
import webbrowser
from pathlib import Path

from torchslam.cli.arguments import at_least
from torchslam.errors import ConfigError, ResultsError

PORT = 8090  # of the page; neither 8080 of other viewers nor 8888 of notebooks
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30}  # of sizes on the command line, bytes
LOCK = ".torchslam-app"  # in the folder: one server at a time


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam app`."""
    add, folder = parser.add_argument, "folder of results, created if needed (default: %(default)s)"
    add("folder", type=Path, nargs="?", default=Path("results"), metavar="FOLDER", help=folder)
    add("--host", default="127.0.0.1", help="address to listen at (default: this computer alone)")
    port = "port; 0: any free one (default: %(default)s)"
    add("--port", type=at_least(0), default=PORT, metavar="N", help=port)
    add("--no-browser", action="store_true", help="do not open the browser")
    upload = "largest upload, for example 500M (default: 4G)"
    add("--max-upload", type=size, default=size("4G"), metavar="SIZE", help=upload)
    most = "number of runs in the folder from which on no more are accepted (default: %(default)s)"
    add("--max-runs", type=at_least(1), default=100, metavar="N", help=most)


def size(text: str) -> int:
    """Parse a size in bytes, such as 4G."""
    found = re.fullmatch(r"(\d{1,12})([KMG]?)B?", text.strip().upper())
    if found is None or not int(found[1]):
        raise argparse.ArgumentTypeError(f"{text!r}: write a size such as 500M or 4G")
    return int(found[1]) * UNITS[found[2]]


def execute(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C; returns the exit status. Raises TorchslamError if it cannot start."""
    if os.name == "nt":
        raise ConfigError("torchslam app needs Linux or macOS: its runs are known by their locks")
    try:
        import uvicorn
        import viser

        from torchslam.app.panel import Panel
        from torchslam.app.web import LOCAL, Uploads, application
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("torchslam"):
            raise
        raise ConfigError(f"the page needs {error.name}: pip install 'torchslam[app]'") from None
    from torchslam.app.jobs import Runs, locked
    from torchslam.app.reading import ReadingProcess

    is_local, host = options.host in ("localhost", "127.0.0.1", "::1"), options.host
    token = "" if is_local else secrets.token_urlsafe(24)
    runs = Runs(options.folder, options.max_runs)
    with contextlib.ExitStack() as at_end:
        try:
            at_end.enter_context(locked(runs.folder / LOCK))
        except BlockingIOError:
            raise ResultsError(f"{runs.folder}: another `torchslam app` serves this folder") from None
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            listening = at_end.enter_context(socket.create_server((host, options.port), family=family))
        except OSError as error:
            where = f"--host {host} --port {options.port}"
            raise ConfigError(f"{where}: {error.strerror}; --port 0 takes a free port") from None
        reader = ReadingProcess()
        at_end.callback(reader.close)
        with contextlib.redirect_stdout(io.StringIO()):  # of the inner server, which refuses browsers
            viewer = viser.ViserServer("127.0.0.1", 0, "torchslam", verbose=False)
        at_end.callback(viewer.stop)
        panel = Panel(viewer, runs, reader)
        at_end.callback(panel.close)
        page = application(viewer, runs, Uploads(runs.folder, options.max_upload), panel, token)
        name = LOCAL[0] if is_local else socket.gethostname() if host in ("0.0.0.0", "::", "") else host
        address = f"http://{name}:{listening.getsockname()[1]}/" + (f"?token={token}" if token else "")
        print(f"torchslam app: {address}\nresults: {runs.folder}\nend: Ctrl-C (runs go on)", flush=True)
        if not options.no_browser:
            webbrowser.open(address)
        # What the viewer sends is large; to compress it takes longer than to send it.
        plain = {"log_level": "warning", "ws": "websockets-sansio", "ws_per_message_deflate": False}
        with contextlib.suppress(KeyboardInterrupt):
            uvicorn.Server(uvicorn.Config(page, **plain)).run(sockets=[listening])
    return 0
