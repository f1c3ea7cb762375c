"""How well does the system do on real sequences? See README.md."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from experiments.common import add_engine, available, metrics_of_runs, row_of, table, write_between

NAMES = ["redkitchen", "kitti07", "machine_hall", "shelf_bin", "fr2_desk_20", "standstill", "synthetic:room"]
ASKED = {
    "redkitchen": "95 %, 0.15 m",
    "kitti07": "95 %, 3 m",
    "machine_hall": "95 %, 0.05 m",
    "shelf_bin": "90 %, 0.02 m",
    "standstill": "no map",
    "synthetic:room": "98 %, 1 % of the path",
}
# ORB-SLAM3 (pyorbslam3 0.1.1), fed in real time on two idle cores, median of three runs: ATE in meters, posed frames.
ORB_SLAM3 = {
    "redkitchen": "0.052, 974",
    "kitti07": "0.30, 156",
    "machine_hall": "0.0056, 319",
    "shelf_bin": "0.0026, 49",
    "fr2_desk_20": "0.0032, 12",
    "standstill": "none, 0",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--config", default=None)
    parser.add_argument("--set", action="append", default=[], metavar="section.key=value")
    parser.add_argument("--no-readme", action="store_true", help="print only")
    add_engine(parser, "sequences")
    arguments = parser.parse_args()
    names = available(arguments.names)
    config = None if arguments.config is None else str(arguments.config.absolute())
    runs = [row_of(name, config=config, overrides=arguments.set) for name in names]
    rows = []
    for name, result in zip(names, metrics_of_runs(runs, arguments), strict=True):
        rows.append(row(name, result))
        print(json.dumps({"sequence": name} | result), flush=True)
    header = ["sequence", "posed", "ATE (m)", "ATE / path", "keyframes", "points"]
    header += ["CPU (ms a frame)", "asked for", "ORB-SLAM3 (m, posed)"]
    text = table(header, rows)
    print(text)
    if not arguments.no_readme:
        write_between(Path(__file__).parent / "README.md", text)


def row(name: str, result: dict) -> list[str]:
    has_path = "ate_m" in result
    return [
        name,
        f"{result['posed']} of {result['frames']}",
        f"{result['ate_m']:.4f}" if has_path else result["failure"] or "no ground truth",
        f"{result['ate_m'] / result['path_length_m']:.2%}" if has_path else "",
        str(result["keyframes"]),
        str(result["points"]),
        f"{1000 * result['cpu_s'] / result['frames']:.0f}",
        ASKED.get(name, ""),
        ORB_SLAM3.get(name, ""),
    ]


if __name__ == "__main__":
    main()
