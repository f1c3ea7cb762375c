"""How right is the scale by markers and boards of a rendered room, and is its stated error? See README.md."""

from __future__ import annotations

import copy
import math

import torch

import experiments.meters.markers.scene  # noqa: F401  it adds the scene
from experiments.common import parser_of, publish, table
from torchslam import SLAM, Config, evaluate, open_sequence
from torchslam.metric.markers.source import Markers
from torchslam.metric.markers.targets import parse_target
from torchslam.metric.scale import ScaleMeasurement
from torchslam.metric.source import SubmapView

TARGETS = {
    "4 tags of one size, a fifth of another one that is stated": "apriltag-36h11:0.16,9=0.2",
    "the same, the size of the fifth is not stated": "apriltag-36h11:0.16",
    "ChArUco board, 7 x 5": "charuco-7x5:0.08:0.06",
    "chessboard, 7 x 5": "chessboard-7x5:0.08",
}
HEADER = "room | targets | error of scale | stated | asked | named"


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for seed in range(options.seeds):
        sequence = open_sequence(f"synthetic:marked?frames=120&seed={seed}&blur=0.8")
        run = SLAM(sequence.camera, Config()).run(sequence)
        assert run.main is not None
        assert sequence.groundtruth is not None
        for name, text in TARGETS.items():
            submap = copy.deepcopy(run.main)
            found = Markers([parse_target(text)]).measure(
                SubmapView(submap, run.camera, 0, sequence, run.readout)
            )
            assert isinstance(found, ScaleMeasurement), found
            scale = evaluate(submap.trajectory(0), sequence.groundtruth).scale
            rows.append(
                [
                    str(seed),
                    name,
                    f"{math.log(found.meters_per_unit / scale):+.2%}",
                    f"{found.relative_std:.2%}",
                    "0.3 %",
                    "; ".join(found.rejected),
                ]
            )
            print(*rows[-1], sep=" | ", flush=True)
    publish(table(HEADER, rows), options, __file__)


if __name__ == "__main__":
    main()
