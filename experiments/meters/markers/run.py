"""How right is the scale by markers and boards of a rendered room, and is its stated error? See README.md."""

from __future__ import annotations

import copy

import torch

import experiments.meters.markers.scene  # noqa: F401  it adds scenes
from experiments.common import parser_of, publish, table
from experiments.meters.scale import scale_by, scale_error, view_of_run
from torchslam import open_sequence
from torchslam.metric.markers.detection import parse_target
from torchslam.metric.markers.source import Markers

CASES = (
    ("tags", "4 tags, a fifth of another size that is stated", "apriltag-36h11:0.16,9=0.2"),
    ("tags", "the same, the size of the fifth is not stated", "apriltag-36h11:0.16"),
    ("charuco", "ChArUco board, 7 x 5", "charuco-7x5:0.12:0.09"),
    ("chessboard", "chessboard, 7 x 5", "chessboard-7x5:0.12"),
)
"""Scene, what is in it, and the option."""
FRAMES = 80
HEADER = "targets | error of scale | stated | asked | named"


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows, runs = [], {}
    for scene, name, text in CASES:
        sequence = open_sequence(f"synthetic:{scene}?frames={FRAMES}&seed={options.seed}&blur=0.8")
        if scene not in runs:
            runs[scene] = view_of_run(sequence)[1]
        view = copy.deepcopy(runs[scene])
        found = scale_by(Markers([parse_target(text)]), view)
        off = scale_error(found, view.submap.trajectory(0), sequence.groundtruth)
        rows.append([name, f"{off:+.2%}", f"{found.relative_std:.2%}", "0.3 %", "; ".join(found.rejected)])
        print(*rows[-1], sep=" | ", flush=True)
    publish(table(HEADER, rows), options, __file__)


if __name__ == "__main__":
    main()
