"""Does the geometry hold where the features are known? See README.md."""

from __future__ import annotations

from experiments.common import add_engine, available, parser_of, row_of, tabulate_runs
from torchslam.batch import Columns

NOISY = ["simulated.noise_px=0.5", "simulated.outlier_ratio=0.1"]
NAMES = ("redkitchen", "kitti07", "synthetic:room")
FEATURES = {"exact": [], "0.5 px, 10 % outliers": NOISY}


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    add_engine(parser, "simulated")
    options = parser.parse_args()
    known = available(NAMES)
    cases = [(name, label) for label in FEATURES for name in known]
    runs = [
        row_of(name, label, overrides=["features.kind=simulated", *FEATURES[label]]) for name, label in cases
    ]

    def cells(number: int, found: Columns) -> list[str]:
        since_start = found["frames"] - (found["initialized_at"] or 0)
        return [
            *cases[number],
            f"{found['posed']} of {found['frames']}",
            f"{found['lost']} of {since_start}",
            f"{found['ate_m']:.2g}",
            f"{found['path_length_m']:.1f}",
            f"{found['ate_m'] / found['path_length_m']:.1e}",
        ]

    header = "trajectory | features | posed | lost after the start | ATE (m) | path (m) | ATE / path"
    tabulate_runs(runs, options, header, cells, __file__)


if __name__ == "__main__":
    main()
