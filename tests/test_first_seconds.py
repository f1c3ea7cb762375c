"""What a user waits for before anything is computed: imports, counted as modules, for seconds depend on the machine."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from torchslam.commands import arguments
from torchslam.data.presets import PRESETS

HEAVY = ("torch", "numpy", "kornia", "cv2", "matplotlib")
CODE = f"""
import sys
from torchslam.cli import main
try:
    status = main(sys.argv[1:])
except SystemExit as end:
    status = end.code
loaded = {{name.split(".")[0] for name in sys.modules}}
print("loaded", status, *(name for name in {HEAVY} if name in loaded))
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
        (["config", "--config", "fast"], "0"),
        (["config", "--set", "seed=-1"], "2"),
        (["nonsense"], "2"),
    ],
    ids=" ".join,
)
def test_nothing_heavy_is_imported_where_nothing_is_computed(command: list[str], status: str) -> None:
    assert loaded(*command) == [status]


def test_info_imports_no_networks_and_no_pictures(tmp_path: Path) -> None:
    status, *modules = loaded("info", "synthetic:room?frames=4")
    assert status == "0"
    assert "torch" in modules  # a camera is one of its tensors
    assert not {"kornia", "matplotlib"} & set(modules)


def test_the_help_names_every_preset() -> None:
    assert arguments.PRESETS.split(", ") == list(PRESETS)
