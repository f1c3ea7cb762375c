"""The system this project started from, on every available sequence. See README.md.

python -m experiments.paper.run [SEQUENCE ...] [--output DIR]
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from experiments.common import DATA_DIR, add_engine, metrics_of_runs, parser_of, row_of, table, write_between
from torchslam.batch.result_store import RUNS
from torchslam.io.results import PLOTS

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
    parser = parser_of(__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="SEQUENCE", help="all by default, and then into the README"
    )
    add_engine(parser, "paper")
    options = parser.parse_args()
    places = find(options.names or SEQUENCES)
    cases = [(place, kind) for place in places for kind in FEATURES]
    runs = [
        replace(
            row_of(place, kind, overrides=[f"features.kind={kind}"], config=str(CONFIG)),
            name=f"{called(place)}_{kind}",
        )
        for place, kind in cases
    ]
    rows, failures, pictures = [], [], {called(place): list[str]() for place in places}
    for (place, kind), made, figures in zip(
        cases, runs, metrics_of_runs(runs, options, plots=True), strict=True
    ):
        name = called(place)
        rows.append(row(name, kind, figures))
        if figures["failure"]:
            failures.append(f"\n{name}, {kind}: {figures['failure']}.\n")
        print(*rows[-1], figures["failure"], sep="\t", flush=True)
        pictures[name].append(picture(options.output / RUNS / made.name / PLOTS / "scene.png"))
    if not options.names:
        shown = [[name, *cells] for name, cells in pictures.items()]
        text = table(HEADER, rows) + "".join(failures) + "\n" + table(["sequence", *FEATURES], shown)
        write_between(HERE / "README.md", text)


def find(names: Iterable[str]) -> list[str]:
    """Paths of the available sequences: rendered, real or downloaded; report the others."""
    found = []
    for name in names:
        folders = [root / name for root in (DATA_DIR, DOWNLOADS) if (root / name).is_dir()]
        if name.startswith("synthetic:"):
            found.append(name)
        elif folders:
            found.append(str(folders[0].absolute()))
        else:
            print(f"{name}: neither in {DATA_DIR} nor in {DOWNLOADS}/, left out")
    return found


def called(place: str) -> str:
    """The name of a sequence in the table."""
    return place.removeprefix("synthetic:").split("/")[-1]


def row(name: str, kind: str, figures: dict[str, Any]) -> list[str]:
    """One line of the table."""
    cells = [name, kind, f"{figures['posed']} of {figures['frames']}"]
    if "ate_m" not in figures:
        return [*cells, "none", *["–"] * (len(HEADER) - len(cells) - 1)]
    return [
        *cells,
        str(figures["initialized_at"]),
        str(figures["keyframes"]),
        str(figures["points"]),
        f"{figures['ate_m']:.2g}",
        f"{figures['path_length_m']:.3g}",
        f"{figures['ate_m'] / figures['path_length_m']:.1e}",
        f"{figures['rpe']['translation_m']:.2g}",
        f"{figures['rpe']['rotation_deg']:.2g}",
    ]


def picture(scene: Path) -> str:
    """Save a small picture of the scene from two views next to the README; return its Markdown."""
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
