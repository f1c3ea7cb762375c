"""Problems of the benchmarks: the fixed ones, in a folder next to the repository, and matches of two images."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

from torch import Tensor

from torchslam.features import match
from torchslam.types import Features

PEERS = Path(__file__).parents[3] / "shared" / "peers"


def load_problems(folder: Path) -> ModuleType:
    """The module `problems.py` of a folder. Exits, naming the option, where there is none."""
    spec = importlib.util.spec_from_file_location("problems", folder / "problems.py")
    if spec is None or spec.loader is None or not (folder / "problems.py").is_file():
        raise SystemExit(f"no problems.py in {folder}; name its folder with --peers")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def match_pixels(first: Features, second: Features, **options: Any) -> tuple[Tensor, Tensor]:
    """Match the first image of each; return the pixels (M, 2) of the matches in both, float64."""
    matches = match(first, second, **options)
    rows = matches.mask[0]
    pixels_1 = first.keypoints[0][matches.indices_1[0][rows]]
    pixels_2 = second.keypoints[0][matches.indices_2[0][rows]]
    return pixels_1.double(), pixels_2.double()
