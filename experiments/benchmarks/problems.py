"""The fixed problems for measuring peers, in a folder next to the repository."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

PEERS = Path(__file__).parents[3] / "shared" / "peers"


def load_problems(folder: Path) -> ModuleType:
    """The module `problems.py` of a folder. Exits, naming the option, where there is none."""
    spec = importlib.util.spec_from_file_location("problems", folder / "problems.py")
    if spec is None or spec.loader is None or not (folder / "problems.py").is_file():
        raise SystemExit(f"no problems.py in {folder}; name its folder with --peers")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
