"""Whatever the documentation says can be run is run here, page by page, in an empty folder."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.docs.running import blocks, run_page
from torchslam.cli.main import main

DOCS = Path(__file__).parents[2] / "docs"
RUN_HERE = sorted(page for page in DOCS.rglob("*.md") if any(blocks(page)))
SLOW = {"own_video.md", "own_front_end.md", "colmap_splat.md", "train.md"}  # several runs, a training


def results_of_the_first_tutorial() -> None:
    command = ["run", "video.mp4", "--camera", "250,250,159.5,119.5", "--output", "results/mine"]
    assert main(command) == 0


def a_folder_of_videos() -> None:
    pytest.importorskip("tensorboard")
    Path("videos").mkdir()
    for name in ("one", "two"):
        shutil.copy("video.mp4", f"videos/{name}.mp4")


BEFORE = {"colmap_splat.md": results_of_the_first_tutorial, "train.md": a_folder_of_videos}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=[pytest.mark.slow] if page.name in SLOW else [])
        for page in RUN_HERE
    ],
)
def test_the_code_of_a_page_runs(page: Path, folder: Path) -> None:
    BEFORE.get(page.name, lambda: None)()
    run_page(page)
