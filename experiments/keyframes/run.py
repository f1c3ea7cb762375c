"""How many keyframes does accuracy need? Recordings with fewer and with more of them. See README.md."""

from __future__ import annotations

from experiments.common import add_engine, available, parser_of, row_of, tabulate_runs
from torchslam.batch import Columns

NAMES = ("redkitchen", "kitti07", "machine_hall", "shelf_bin")
FRAMES = 400
RULES = {
    "half as dense": ("keyframes.max_translation=0.2", "keyframes.min_overlap=0.6"),
    "less dense": ("keyframes.max_translation=0.14", "keyframes.min_overlap=0.7"),
    "the default": (),
    "denser": ("keyframes.max_translation=0.07", "keyframes.min_overlap=0.9"),
}
HEADER = "sequence | rule | keyframes | ATE, m | posed | CPU ms a frame"


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("names", nargs="*", default=list(NAMES))
    add_engine(parser, "keyframes")
    options = parser.parse_args()
    cases = [(name, rule) for name in available(options.names) for rule in RULES]
    runs = [row_of(name, rule, overrides=RULES[rule], limit=FRAMES) for name, rule in cases]

    def cells(number: int, found: Columns) -> list[str]:
        return [
            *cases[number],
            str(found["keyframes"]),
            f"{found['ate_m']:.4f}",
            f"{found['posed']} of {found['frames']}",
            f"{1e3 * found['cpu_s'] / found['frames']:.0f}",
        ]

    tabulate_runs(runs, options, HEADER, cells, __file__)


if __name__ == "__main__":
    main()
