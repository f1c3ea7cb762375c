"""`torchslam app`: the viewer, the HTTP part and the runs of a folder in one server."""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import io
import secrets
import socket
import webbrowser

from torchslam.app.jobs import Runs
from torchslam.app.reading import ReadingProcess
from torchslam.errors import ConfigError, ResultsError

LOCK = ".torchslam-app"  # in the folder: one server at a time
ANY = ("0.0.0.0", "::", "")  # addresses of all networks


def serve(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C; returns the exit status. Raises TorchslamError if it cannot start."""
    try:
        import uvicorn
        import viser

        from torchslam.app.panel import Panel
        from torchslam.app.web import LOCAL, Uploads, application
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("torchslam"):
            raise
        raise ConfigError(f"the page needs {error.name}: pip install 'torchslam[app]'") from None
    is_local = options.host in ("localhost", "127.0.0.1", "::1")
    token = "" if is_local else secrets.token_urlsafe(24)
    runs = Runs(options.folder, options.max_runs)
    with contextlib.ExitStack() as at_end:
        held = at_end.enter_context((runs.folder / LOCK).open("ab"))
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ResultsError(f"{runs.folder}: another `torchslam app` serves this folder") from None
        listening = at_end.enter_context(_listen(options.host, options.port))
        reader = ReadingProcess()
        at_end.callback(reader.close)
        with contextlib.redirect_stdout(
            io.StringIO()
        ):  # the address of the inner server, which refuses browsers
            viewer = viser.ViserServer("127.0.0.1", 0, "torchslam", verbose=False)
        at_end.callback(viewer.stop)
        panel = Panel(viewer, runs, reader)
        at_end.callback(panel.close)
        page = application(viewer, Uploads(runs.folder, options.max_upload), panel, token)
        name = LOCAL[0] if is_local else socket.gethostname() if options.host in ANY else options.host
        address = f"http://{name}:{listening.getsockname()[1]}/" + (f"?token={token}" if token else "")
        print(f"torchslam app: {address}\nresults: {runs.folder}\nend: Ctrl-C (runs go on)", flush=True)
        if not options.no_browser:
            webbrowser.open(address)
        # What the viewer sends is large; to compress it takes longer than to send it.
        config = uvicorn.Config(
            page, log_level="warning", ws="websockets-sansio", ws_per_message_deflate=False
        )
        with contextlib.suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listening])
    return 0


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise ConfigError(
            f"--host {host} --port {port}: {error.strerror}; --port 0 takes a free port"
        ) from None
