"""How many keyframes does accuracy need? Recordings with fewer and with more of them. See README.md."""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.common import add_engine, available, metrics_of_runs, row_of, table, write_between

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
    add_engine(parser, "keyframes")
    options = parser.parse_args()
    cases = [(name, rule) for name in available(options.names) for rule in RULES]
    runs = [row_of(name, rule, overrides=RULES[rule], limit=FRAMES) for name, rule in cases]
    rows = []
    for (name, rule), found in zip(cases, metrics_of_runs(runs, options), strict=True):
        cpu = 1e3 * found["cpu_s"] / found["frames"]
        row = [name, rule, str(found["keyframes"])]
        row += [f"{found['ate_m']:.4f}", f"{found['posed']} of {found['frames']}", f"{cpu:.0f}"]
        rows.append(row)
        print(*row, sep=" | ", flush=True)
    if not options.no_readme:
        write_between(Path(__file__).parent / "README.md", table(HEADER, rows))


if __name__ == "__main__":
    main()
