"""Does the geometry hold where the features are known? See README.md."""

from __future__ import annotations

from pathlib import Path

from experiments.common import figures, sequences, table, write_between
from torchslam.config import load_config

NOISY = ["simulated.noise_px=0.5", "simulated.outliers=0.1"]
CASES = [
    ("redkitchen", "exact", []),
    ("kitti07", "exact", []),
    ("synthetic:room", "exact", []),
    ("redkitchen", "0.5 px, 10 % outliers", NOISY),
    ("kitti07", "0.5 px, 10 % outliers", NOISY),
    ("synthetic:room", "0.5 px, 10 % outliers", NOISY),
]


def main() -> None:
    rows = []
    for name, label, overrides in CASES:
        for sequence in sequences([name]):
            result = figures(sequence, load_config(None, ["features.kind=simulated", *overrides]))
            since_start = result["frames"] - (result["initialised_at"] or 0)
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
