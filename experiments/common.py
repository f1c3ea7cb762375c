"""What the experiments share: where sequences lie, one run with its figures, Markdown tables."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from torchslam.config import Config
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.evaluation import MIN_POSES, evaluate
from torchslam.output.report import metrics
from torchslam.slam import SLAM

DATA_DIR = Path(os.environ.get("TORCHSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))


def sequences(names: list[str]) -> list[Sequence]:
    """Open those of the sequences that are at hand; say which are not."""
    found = []
    for name in names:
        if name.startswith("synthetic:"):
            found.append(open_sequence(name))
        elif (DATA_DIR / name).is_dir():
            found.append(open_sequence(DATA_DIR / name))
        else:
            print(f"{name}: not at {DATA_DIR}, left out")
    return found


def figures(sequence: Sequence, config: Config) -> dict:
    """Run a sequence and return its metrics, with `failure` where there is no map."""
    torch.set_num_threads(1)
    run = SLAM(sequence.camera, config).run(sequence)
    evaluation = None
    if sequence.groundtruth is not None and len(run.trajectory) >= MIN_POSES:
        evaluation = evaluate(run.trajectory, sequence.groundtruth)
    return metrics(run, evaluation) | {"failure": run.failure}


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def write_between(readme: Path, text: str) -> None:
    """Replace what stands between the two marks `<!-- table -->` and `<!-- end -->` of a README."""
    before, _, rest = readme.read_text(encoding="utf-8").partition("<!-- table -->\n")
    _, _, after = rest.partition("<!-- end -->")
    readme.write_text(f"{before}<!-- table -->\n{text}<!-- end -->{after}", encoding="utf-8")
