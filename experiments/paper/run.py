"""The system this project started from, on every sequence at hand. See README.md.

python -m experiments.paper.run [SEQUENCE ...] [--output DIR]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from experiments.common import DATA_DIR, table, write_between
from torchslam.config import Config, load_config
from torchslam.data import Sequence, open_sequence
from torchslam.errors import TrajectoryError
from torchslam.evaluation import evaluate
from torchslam.output.pictures import draw
from torchslam.output.report import metrics
from torchslam.output.results import PLOTS, read_results, write_results
from torchslam.slam import SLAM

HERE = Path(__file__).parent
CONFIG = HERE.parents[1] / "configs" / "paper.toml"
DOWNLOADS = Path("data")
SEQUENCES = (
    "plant_1",
    "table_3",
    "synthetic:room",
    "redkitchen",
    "kitti07",
    "machine_hall",
    "fr2_desk_20",
    "shelf_bin",
)
FEATURES = ("simulated", "orb")
HEADER = ["sequence", "features", "posed", "start", "keyframes", "points", "ATE (m)", "path (m)", "ATE / path",
          "RPE (m)", "RPE (°)"]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="SEQUENCE", help="all by default, and then into the README"
    )
    parser.add_argument("--output", type=Path, default=Path("results/paper"), metavar="DIR")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows, failures, pictures = [], [], []
    for sequence in find(options.names or SEQUENCES):
        shown = []
        for kind in FEATURES:
            directory = options.output / f"{sequence.name}_{kind}"
            figures = run(sequence, load_config(CONFIG, [f"features.kind={kind}"]), directory)
            rows.append(row(sequence.name, kind, figures))
            if figures["failure"]:
                failures.append(f"\n{sequence.name}, {kind}: {figures['failure']}.\n")
            print(*rows[-1], figures["failure"], sep="\t", flush=True)
            shown.append(directory / PLOTS / "scene.png")
        pictures.append([sequence.name, *(picture(scene) for scene in shown)])
    if not options.names:
        text = table(HEADER, rows) + "".join(failures) + "\n" + table(["sequence", *FEATURES], pictures)
        write_between(HERE / "README.md", text)


def find(names: Iterable[str]) -> Iterator[Sequence]:
    """The sequences that are at hand: rendered, among the real ones, or downloaded; says which are not."""
    for name in names:
        folders = [root / name for root in (DATA_DIR, DOWNLOADS) if (root / name).is_dir()]
        if name.startswith("synthetic:"):
            yield open_sequence(name)
        elif folders:
            yield open_sequence(folders[0])
        else:
            print(f"{name}: neither in {DATA_DIR} nor in {DOWNLOADS}/, left out")


def run(sequence: Sequence, config: Config, directory: Path) -> dict[str, Any]:
    """One run with its results and pictures written; returns its figures."""
    finished = SLAM(sequence.camera, config).run(sequence)
    evaluation = None
    if sequence.groundtruth is not None and not finished.failure:
        try:
            evaluation = evaluate(finished.trajectory, sequence.groundtruth)
        except TrajectoryError as error:
            print(f"{sequence.name}: {error}")
    figures = metrics(finished, evaluation)
    write_results(finished, sequence, figures, directory)
    draw(read_results(directory), directory)
    return figures


def row(name: str, kind: str, figures: dict[str, Any]) -> list[str]:
    """One line of the table."""
    cells = [name, kind, f"{figures['posed']} of {figures['frames']}"]
    if "ate_m" not in figures:
        return [*cells, "none", *["–"] * (len(HEADER) - len(cells) - 1)]
    return [
        *cells,
        str(figures["initialised_at"]),
        str(figures["keyframes"]),
        str(figures["points"]),
        f"{figures['ate_m']:.2g}",
        f"{figures['path_length_m']:.3g}",
        f"{figures['ate_m'] / figures['path_length_m']:.1e}",
        f"{figures['rpe']['translation_m']:.2g}",
        f"{figures['rpe']['rotation_deg']:.2g}",
    ]


def picture(scene: Path) -> str:
    """Put a small copy of the scene from two views beside the README; returns what shows it there."""
    if not scene.exists():
        return "no map"
    name = scene.parents[1].name
    target = HERE / "pictures" / f"{name}.png"
    target.parent.mkdir(exist_ok=True)
    with Image.open(scene) as image:
        image.convert("RGB").resize((1000, round(1000 * image.height / image.width))).quantize(256).save(
            target
        )
    return f"![{name}](pictures/{target.name})"


if __name__ == "__main__":
    main()
