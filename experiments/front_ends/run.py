"""Which front end should one take? See README.md."""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.common import (
    DATA_DIR,
    add_engine,
    available,
    metrics_of_runs,
    row_of,
    table,
    write_between,
)

NAMES = ["shelf_bin", "fr2_desk_20", "kitti07", "machine_hall"]
FRONT_ENDS = {"orb": "", "opencv-orb": "", "xfeat": "xfeat.safetensors", "aliked": "aliked-t16.safetensors"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--front-ends", nargs="*", default=list(FRONT_ENDS), choices=list(FRONT_ENDS))
    parser.add_argument(
        "--weights", type=Path, default=DATA_DIR.parent / "weights", help="folder of the weights"
    )
    parser.add_argument("--no-readme", action="store_true", help="print only")
    add_engine(parser, "front_ends")
    arguments = parser.parse_args()
    settings = {
        kind: found
        for kind in arguments.front_ends
        if (found := overrides(kind, arguments.weights)) is not None
    }
    cases = [(name, kind) for name in available(arguments.names) for kind in settings]
    runs = [row_of(name, kind, overrides=settings[kind]) for name, kind in cases]
    rows = []
    for (name, kind), result in zip(cases, metrics_of_runs(runs, arguments), strict=True):
        rows.append(row(name, kind, result))
        print(*rows[-1], sep="\t", flush=True)
    text = table(["sequence", "front end", "posed", "ATE (m)", "features (ms)", "frames/s"], rows)
    if not arguments.no_readme:
        write_between(Path(__file__).parent / "README.md", text)


def overrides(kind: str, folder: Path) -> list[str] | None:
    """The settings of a front end; None, and a word about it, where its weights are not in the folder."""
    if not FRONT_ENDS[kind]:
        return [f"features.kind={kind}"]
    weights = (folder / FRONT_ENDS[kind]).absolute()
    if not weights.is_file():
        print(f"{kind}: no {weights}, left out")
        return None
    return [f"features.kind={kind}", f'features.weights="{weights}"']


def row(name: str, kind: str, result: dict) -> list[str]:
    return [
        name,
        kind,
        f"{result['posed']} of {result['frames']}",
        f"{result['ate_m']:.4f}" if "ate_m" in result else result["failure"],
        f"{result['stage_ms']['features']['median']:.0f}",
        f"{result['fps']:.1f}",
    ]


if __name__ == "__main__":
    main()
