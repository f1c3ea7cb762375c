"""How accurate is the system on real sequences? See README.md."""

from __future__ import annotations

from pathlib import Path

from experiments.common import add_engine, available, parser_of, row_of, tabulate_runs
from torchslam.batch import Columns

NAMES = ["redkitchen", "kitti07", "machine_hall", "shelf_bin", "fr2_desk_20", "standstill", "synthetic:room"]
REQUIRED = {
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
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="section.key=value")
    add_engine(parser, "sequences")
    arguments = parser.parse_args()
    names = available(arguments.names)
    config = None if arguments.config is None else str(arguments.config.absolute())
    runs = [row_of(name, config=config, overrides=arguments.set) for name in names]
    header = (
        "sequence | posed | ATE (m) | ATE / path | keyframes | points | CPU (ms a frame) | required"
        " | ORB-SLAM3 (m, posed)"
    )
    tabulate_runs(runs, arguments, header, lambda number, found: cells(names[number], found), __file__)


def cells(name: str, result: Columns) -> list[str]:
    has_path = "ate_m" in result
    return [
        name,
        f"{result['posed']} of {result['frames']}",
        f"{result['ate_m']:.4f}" if has_path else result["failure"] or "no ground truth",
        f"{result['ate_m'] / result['path_length_m']:.2%}" if has_path else "",
        str(result["keyframes"]),
        str(result["points"]),
        f"{1000 * result['cpu_s'] / result['frames']:.0f}",
        REQUIRED.get(name, ""),
        ORB_SLAM3.get(name, ""),
    ]


if __name__ == "__main__":
    main()
