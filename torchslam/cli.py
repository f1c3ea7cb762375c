"""The command line: `torchslam run | refine | demo | eval | plot | export | info | download`.

Exit status: 0 done, 2 an error that the message explains, 3 no map could be initialised or no frame be localised,
130 and 143 ended by Ctrl-C and by SIGTERM.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

import torch

from torchslam import __version__
from torchslam.commands import demo, download, evaluate, export, info, plot, refine, run
from torchslam.errors import TorchslamError

ERROR = 2
INTERRUPTED = 130

COMMANDS = {
    "run": run,
    "refine": refine,
    "demo": demo,
    "eval": evaluate,
    "plot": plot,
    "export": export,
    "info": info,
    "download": download,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status. Errors made on purpose become one line on stderr."""
    options = build_parser().parse_args(arguments)
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)  # a frame's tensors are small: threads cost more than they bring
    try:
        return options.execute(options)
    except (TorchslamError, OSError) as error:
        print(f"torchslam: error: {error}", file=sys.stderr)
        return ERROR
    except KeyboardInterrupt:
        print("torchslam: interrupted", file=sys.stderr)
        return INTERRUPTED


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; each command's module adds its own arguments."""
    parser = argparse.ArgumentParser(
        prog="torchslam",
        description="Monocular visual SLAM: images in, the camera's trajectory and a sparse map out.",
    )
    parser.add_argument("--version", action="version", version=f"torchslam {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, module in COMMANDS.items():
        description = (module.__doc__ or "").strip()
        summary = description.split("\n")[0].rstrip(".")
        command = commands.add_parser(
            name,
            help=summary[0].lower() + summary[1:],
            description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(command)
        command.set_defaults(execute=module.execute)
    return parser


if __name__ == "__main__":
    sys.exit(main())
