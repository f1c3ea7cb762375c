"""Which front end should one take? See README.md."""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.common import DATA_DIR, figures, sequences, table, write_between
from torchslam.config import load_config

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
    arguments = parser.parse_args()
    rows = []
    for name in arguments.names:
        for kind in arguments.front_ends:
            weights = arguments.weights / FRONT_ENDS[kind]
            if FRONT_ENDS[kind] and not weights.is_file():
                print(f"{kind}: no {weights}, left out")
                continue
            overrides = [f"features.kind={kind}"] + (
                [f'features.weights="{weights}"'] if FRONT_ENDS[kind] else []
            )
            for sequence in sequences([name]):
                rows.append(row(name, kind, figures(sequence, load_config(None, overrides))))
                print(*rows[-1], sep="\t", flush=True)
    text = table(["sequence", "front end", "posed", "ATE (m)", "features (ms)", "frames/s"], rows)
    if not arguments.no_readme:
        write_between(Path(__file__).parent / "README.md", text)


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
