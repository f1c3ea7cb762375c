"""The folder of results of a short run over rendered frames, and what the tests of commands share."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest
import torch

from torchslam.cli.main import main
from torchslam.data import open_sequence

ROOM = "synthetic:room?frames=16"
FAST = ["--features", "opencv-orb", "--set", "features.num_keypoints=500"]


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of results of a run that went well; tests leave it as it is."""
    directory = tmp_path_factory.mktemp("run")
    assert main(["run", ROOM, "--output", str(directory), *FAST, "--seed", "7"]) == 0
    return directory


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """A copy of those results, without plots."""
    ignored = shutil.ignore_patterns("export", "plots")
    return Path(shutil.copytree(finished, tmp_path / "copy", ignore=ignored))


def write_tum_folder(folder: Path, frames: int = 6) -> Path:
    """A few rendered frames as a TUM folder with a calibration."""
    sequence = open_sequence(f"synthetic:room?frames={frames}")
    (folder / "rgb").mkdir(parents=True)
    lines = []
    for index in range(frames):
        image = (sequence.image(index)[0, 0] * 255).round().to(torch.uint8).numpy()
        cv2.imwrite(str(folder / "rgb" / f"{index}.png"), image)
        lines.append(f"{index / 20:.2f} rgb/{index}.png")
    (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
    (folder / "calibration.txt").write_text("500 500 319.5 239.5\n")
    return folder
