"""What a user waits for before anything is computed: imports, counted as modules, for seconds depend on the machine."""

from __future__ import annotations

import subprocess
import sys

import pytest

from torchslam.cli import arguments
from torchslam.data.calibration import PRESETS

HEAVY = ("torch", "numpy", "kornia", "cv2", "matplotlib", "torchslam.system.slam", "torchslam.system.run")
CODE = f"""
import sys
from torchslam.cli.main import main
try:
    status = main(sys.argv[1:])
except SystemExit as end:
    status = end.code
print("loaded", status, *(name for name in {HEAVY} if name in sys.modules))
"""


def loaded(*command: str) -> list[str]:
    """The exit status of a command, and the heavy modules that it imported."""
    out = subprocess.run([sys.executable, "-c", CODE, *command], capture_output=True, text=True, check=True)
    return out.stdout.splitlines()[-1].split()[1:]


@pytest.mark.parametrize(
    ("command", "status"),
    [
        (["--help"], "0"),
        (["--version"], "0"),
        (["info", "--help"], "0"),
        (["info", "--stride", "none", "x"], "2"),
        (["config", "--config", "paper"], "0"),
        (["config", "--set", "seed=-1"], "2"),
        (["nonsense"], "2"),
    ],
    ids=" ".join,
)
def test_commands_that_compute_nothing_import_no_heavy_modules(command: list[str], status: str) -> None:
    assert loaded(*command) == [status]


def test_info_imports_only_the_readers() -> None:
    status, *modules = loaded("info", "synthetic:room?frames=2&blank=1")
    assert status == "0"
    assert set(modules) == {"torch", "numpy", "cv2"}  # a camera is a tensor


def test_help_lists_every_preset() -> None:
    assert arguments.PRESETS.split(", ") == list(PRESETS)
