"""What `import torchslam` shows, and what it loads."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import torchslam

ROOT = Path(__file__).parents[1]
PACKAGES = ("calibration", "data", "dense", "features", "geometry", "learning", "optim", "refine")
MODULES = ("errors", "evaluation", "types")


def fresh(code: str) -> str:
    """What an interpreter prints that has imported nothing yet."""
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout


def test_packages_load_when_they_are_asked_for() -> None:
    names = (*PACKAGES, *MODULES)
    code = f"import torchslam\nfor name in {names}: print(getattr(torchslam, name).__name__)"
    assert fresh(code).split() == [f"torchslam.{name}" for name in names]


def test_the_import_loads_no_torch() -> None:
    assert fresh("import sys, torchslam; dir(torchslam); print('torch' in sys.modules)").strip() == "False"


def test_dir_shows_public_names_and_packages_alone() -> None:
    assert dir(torchslam) == sorted([*torchslam.__all__, *PACKAGES, *MODULES, "__version__"])


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_exists(package: str) -> None:
    module = import_module(f"torchslam.{package}")
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        getattr(module, name)


def test_one_module_imports_what_torch_keeps_private() -> None:
    private = re.compile(r"torch\._|torch\.utils import _|_current_level|_utils\.collate")
    users = [path for path in (ROOT / "torchslam").rglob("*.py") if private.search(path.read_text("utf-8"))]
    assert [path.name for path in users] == ["torch_internals.py"]
