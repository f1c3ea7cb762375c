"""How many keyframes does accuracy need? Recordings with fewer and with more of them. See README.md."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from experiments.common import figures, sequences, table, write_between
from torchslam.config import load_config

NAMES = ("redkitchen", "kitti07", "machine_hall", "shelf_bin")
FRAMES = 400
RULES = {
    "half as dense": ("keyframes.max_translation=0.2", "keyframes.min_overlap=0.6"),
    "less dense": ("keyframes.max_translation=0.14", "keyframes.min_overlap=0.7"),
    "the default": (),
    "denser": ("keyframes.max_translation=0.07", "keyframes.min_overlap=0.9"),
}
HEADER = ["sequence", "rule", "keyframes", "ATE, m", "posed", "CPU ms a frame"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(NAMES))
    parser.add_argument("--no-readme", action="store_true", help="print only")
    options = parser.parse_args()
    rows = []
    for sequence in sequences(options.names):
        part = sequence.part(0, min(FRAMES, len(sequence)))
        for rule, settings in RULES.items():
            begin = time.process_time()
            found = figures(part, load_config(None, settings))
            cpu = 1e3 * (time.process_time() - begin) / len(part)
            row = [sequence.name, rule, str(found["keyframes"])]
            row += [f"{found['ate_m']:.4f}", f"{found['posed']} of {len(part)}", f"{cpu:.0f}"]
            rows.append(row)
            print(*row, sep=" | ", flush=True)
    if not options.no_readme:
        write_between(Path(__file__).parent / "README.md", table(HEADER, rows))


if __name__ == "__main__":
    main()
