"""Which feature extractor is best? See README.md."""

from __future__ import annotations

from pathlib import Path

from experiments.common import (
    LEARNED_FEATURES,
    add_engine,
    add_weights,
    available,
    parser_of,
    row_of,
    tabulate_runs,
    weights_of,
)
from torchslam.batch import Columns

NAMES = ["shelf_bin", "fr2_desk_20", "kitti07", "machine_hall"]
FRONT_ENDS = ("orb", "opencv-orb", *LEARNED_FEATURES)


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--front-ends", nargs="*", default=list(FRONT_ENDS), choices=list(FRONT_ENDS))
    add_weights(parser)
    add_engine(parser, "front_ends")
    arguments = parser.parse_args()
    settings = {
        kind: found
        for kind in arguments.front_ends
        if (found := overrides(kind, arguments.weights)) is not None
    }
    cases = [(name, kind) for name in available(arguments.names) for kind in settings]
    runs = [row_of(name, kind, overrides=settings[kind]) for name, kind in cases]
    header = "sequence | feature extractor | posed | ATE (m) | features (ms) | frames/s"
    tabulate_runs(runs, arguments, header, lambda number, found: [*cases[number], *cells(found)], __file__)


def overrides(kind: str, folder: Path) -> list[str] | None:
    """The settings of a feature extractor; None, with a message, if its weights are not in the folder."""
    if kind not in LEARNED_FEATURES:
        return [f"features.kind={kind}"]
    weights = weights_of(kind, folder)
    return None if weights is None else [f"features.kind={kind}", f'features.weights="{weights}"']


def cells(found: Columns) -> list[str]:
    return [
        f"{found['posed']} of {found['frames']}",
        f"{found['ate_m']:.4f}" if "ate_m" in found else found["failure"],
        f"{found['stage_ms']['features']['median']:.0f}",
        f"{found['fps']:.1f}",
    ]


if __name__ == "__main__":
    main()
