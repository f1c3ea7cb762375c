"""Does a model of the rolling shutter pay? See README.md."""

from __future__ import annotations

from pathlib import Path

import torch

from experiments.common import available, focal_of, parser_of, place_of, table, write_between
from torchslam.config import CameraConfig, Config
from torchslam.data import open_sequence
from torchslam.evaluation import evaluate
from torchslam.system.slam import SLAM

HERE = Path(__file__).parent
HEADER = (
    "sequence | posed | readout (ms) | ATE (mm) | ATE, global shutter (mm) | ATE, online (mm) | f (px)"
    " | f, global shutter (px)"
)
ROOMS = [f"synthetic:room?readout={ms}{pace}" for pace in ("", "&pace=2") for ms in (0, 10, 30)]
RECORDINGS = ["redkitchen", "fr2_desk_20", "kitti07", "machine_hall", "shelf_bin"]
GLOBAL_SHUTTER = CameraConfig(readout_std=0.0)


def row_of(name: str) -> list[str]:
    """Two runs on a sequence: with the readout to be found, and as if all rows were exposed at once."""
    sequence = open_sequence(place_of(name))
    assert sequence.groundtruth is not None
    found, told = (
        SLAM(sequence.camera, Config(camera=camera)).run(sequence)
        for camera in (CameraConfig(), GLOBAL_SHUTTER)
    )
    errors = (
        f"{1e3 * evaluate(each, sequence.groundtruth).ate_m:.2f}"
        for each in (found.trajectory, told.trajectory, found.online)
    )
    return [
        name.removeprefix("synthetic:"),
        str(len(found.trajectory)),
        "none" if found.readout is None else found.readout.description().removesuffix(" ms"),
        *errors,
        focal_of(found),
        focal_of(told),
    ]


def main() -> None:
    """Run the sequences that are there and write the table."""
    parser = parser_of(__doc__)
    parser.add_argument("names", nargs="*", default=[*ROOMS, *RECORDINGS], help="sequences")
    torch.set_num_threads(1)
    rows = []
    for name in available(parser.parse_args().names):
        rows.append(row_of(name))
        print(" | ".join(rows[-1]), flush=True)
    write_between(HERE / "README.md", table(HEADER, rows))


if __name__ == "__main__":
    main()
