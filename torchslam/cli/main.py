"""The command line: `torchslam COMMAND`, with the commands of `COMMANDS`.

Exit status: 0 done, 2 an error that the message explains, 3 no map could be initialized or no frame could be
localized, 4 some sequences of a batch failed, 130 and 143 ended by Ctrl-C and by SIGTERM, 141 whoever read the output
is gone, as of `torchslam ... | head`.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import select
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn, TextIO

import torchslam
from torchslam.errors import TorchslamError
from torchslam.utils.console import printable, say, with_install_hint, without_credentials
from torchslam.utils.memory import keep_freed_memory

ERROR = 2
"""Exit status of an error, as of argparse."""

# The first line of the description of each command.
COMMANDS = {
    "run": "run SLAM on a sequence and write trajectory, map, metrics and plots",
    "app": "open a page in the browser: drop a video, watch the map grow, measure, and take the result away",
    "batch": "run many sequences and write one table: in one process, as shards of a job array, or on Ray",
    "refine": "refine the poses of another program from the images and write them in their original format",
    "align": "scale a finished run to meters by markers, clicked lengths, the camera height, or other measurements",
    "densify": "compute dense depth of a run from its map and images: depth maps, a colored cloud and pictures",
    "demo": "run SLAM on a rendered room, evaluate and plot it: the whole system without any data",
    "eval": "compare two trajectories in TUM format: absolute and relative errors",
    "plot": "redraw the plots and view.html of a run from its results folder",
    "export": "export map and trajectory of a run to other programs: COLMAP, nerfstudio, MeshLab, rerun, evo",
    "info": "describe a sequence: frames, size, rate, calibration, ground truth",
    "config": "print every setting with its description, range and default, as TOML for --config",
    "download": "download a public sequence or weights; an interrupted transfer is resumed",
}
SMALL = ("demo", "eval", "plot", "info", "config", "download")  # in `commands`; others have their own module

# These compute nothing, and import torch only where a sequence is opened.
WITHOUT_THREADS = ("app", "config", "info")


def console() -> NoReturn:
    """Run the command of this process, and exit with its status.

    A stream that has gone away may hold its thread in OpenCV for half a minute. Python's own way to exit would end that
    thread from within, which aborts the process, so then nothing but the buffers is left to be done.
    """
    gc.disable()  # until `main` has imported what it needs
    try:
        status = main()
    except SystemExit as end:  # of argparse
        status = int(end.code or 0)
    except BrokenPipeError:  # of the message itself
        status = ERROR
    status = _flushed(status)
    live = sys.modules.get("torchslam.data.readers.live")  # imports torch
    if live is not None and not live.close_sources():
        os._exit(status)
    gc.freeze()  # else Python searches for garbage among all that ends with the process: .3 s
    sys.exit(status)


def _flushed(status: int) -> int:
    """Flush the output; return the status, 141 where nobody reads it any more, which Python would report at exit."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(BrokenPipeError):
            stream.flush()
        if _is_abandoned(stream):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            status = 141  # 128 and the number of SIGPIPE, as of shells
    return status


def _is_abandoned(stream: TextIO) -> bool:
    """Whether a stream is a pipe that nobody reads any more."""
    try:
        poll = select.poll()
        poll.register(stream.fileno(), 0)
    except (AttributeError, OSError):  # Windows; a stream without a file
        return False
    return any(event & select.POLLERR for _, event in poll.poll(0))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Expected errors become one line on stderr."""
    # Before NumPy is imported: its threads would compete with those of the other processes.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        options = _parse(arguments)
        if not gc.isenabled():
            # Imports leave 200,000 objects that stay: each search for garbage among them takes a tenth of a second.
            gc.freeze()
            gc.enable()
        if options.command not in WITHOUT_THREADS:
            _prepare_to_compute()
        return options.execute(options)
    except (TorchslamError, OSError) as error:
        if isinstance(error, BrokenPipeError) and (abandoned := _flushed(0)):
            return abandoned
        say(f"error: {printable(without_credentials(str(error)))}")
        return ERROR
    except ModuleNotFoundError as error:
        if (reason := with_install_hint(error)) is error:
            raise
        say(f"error: {reason}")
        return ERROR
    except KeyboardInterrupt:
        say("interrupted")
        return 130  # 128 and the number of the signal, as of shells


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments; say what to do where a shell has made many files of a pattern."""
    parser = build_parser(next(iter(arguments), ""))
    options, left = parser.parse_known_args(arguments)
    files = [Path(word) for word in left if not word.startswith("-") and Path(word).is_file()]
    first = Path(getattr(options, "path", ""))
    if files and first.suffix and first.is_file():
        pattern = first.with_name(f"*{first.suffix}")
        parser.error(
            f"{len(files) + 1} files instead of one path, the first {first}: a shell expands patterns; give the folder "
            f"{first.parent}, or the pattern in quotes: '{pattern}'"
        )
    if left:
        parser.error(f"unrecognized arguments: {' '.join(left)}")
    return options


class Version(argparse.Action):
    """Print the version; reading the package metadata is slow and done only here."""

    def __call__(self, parser: argparse.ArgumentParser, *arguments: Any) -> None:
        print(f"torchslam {torchslam.__version__}")
        parser.exit()


def _prepare_to_compute() -> None:
    """Use one thread, and keep freed memory: the tensors of a frame are small and many.

    OMP_NUM_THREADS may ask PyTorch for more threads. OpenCV does not read it; a thread of OpenCV would keep workers
    from being forks, and still run while the process exits.
    """
    import cv2  # both after the arguments were checked
    import torch

    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)
    cv2.setNumThreads(1)
    keep_freed_memory()


def load_command(name: str) -> tuple[str, Callable[..., None], Callable[..., int]]:
    """Import a command; return its description, and the functions that add its arguments and execute it."""
    from inspect import getdoc

    home, suffix = ("commands", f"_{name}") if name in SMALL else (name, "")
    home = "torchslam.app" if name == "app" else f"torchslam.cli.{home}"
    module = import_module(home)  # that of the requested command alone
    execute = getattr(module, f"execute{suffix}")
    about = getdoc(execute if suffix else module) or ""
    return about, getattr(module, f"add_arguments{suffix}"), execute


def build_parser(chosen: str) -> argparse.ArgumentParser:
    """Build the parser of all commands, with the arguments of the chosen one only."""
    parser = argparse.ArgumentParser(
        prog="torchslam",
        description="Monocular visual SLAM: images in, the camera's trajectory and a sparse map out.",
    )
    parser.add_argument("--version", action=Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    raw = argparse.RawDescriptionHelpFormatter
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary, formatter_class=raw)
        if name == chosen:
            about, add_arguments, execute = load_command(name)
            # Its first line before the options, so that these are on the first screen.
            command.description, _, command.epilog = about.partition("\n\n")
            add_arguments(command)
            command.set_defaults(execute=execute)
    return parser


if __name__ == "__main__":
    console()
