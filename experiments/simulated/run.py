"""Does the geometry hold where the features are known? See README.md."""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.common import add_engine, available, metrics_of_runs, row_of, table, write_between

NOISY = ["simulated.noise_px=0.5", "simulated.outlier_ratio=0.1"]
CASES = [
    ("redkitchen", "exact", []),
    ("kitti07", "exact", []),
    ("synthetic:room", "exact", []),
    ("redkitchen", "0.5 px, 10 % outliers", NOISY),
    ("kitti07", "0.5 px, 10 % outliers", NOISY),
    ("synthetic:room", "0.5 px, 10 % outliers", NOISY),
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_engine(parser, "simulated")
    options = parser.parse_args()
    known = available(dict.fromkeys(name for name, _, _ in CASES))
    cases = [case for case in CASES if case[0] in known]
    runs = [
        row_of(name, label, overrides=["features.kind=simulated", *overrides])
        for name, label, overrides in cases
    ]
    rows = []
    for (name, label, _), result in zip(cases, metrics_of_runs(runs, options), strict=True):
        since_start = result["frames"] - (result["initialized_at"] or 0)
        share = result["ate_m"] / result["path_length_m"]
        rows.append(
            [name, label, f"{result['posed']} of {result['frames']}", f"{result['lost']} of {since_start}",
             f"{result['ate_m']:.2g}", f"{result['path_length_m']:.1f}", f"{share:.1e}"]
        )  # fmt: skip
        print(*rows[-1], sep="\t", flush=True)
    header = ["trajectory", "features", "posed", "lost after the start", "ATE (m)", "path (m)", "ATE / path"]
    write_between(Path(__file__).parent / "README.md", table(header, rows))


if __name__ == "__main__":
    main()
