"""How right is the scale by the height of a camera above the ground, and is its stated error? See README.md."""

from __future__ import annotations

import torch

from experiments.common import parser_of, publish, sequences, table
from experiments.meters.scale import scale_by, scale_error, view_of_run
from torchslam.metric.camera_height import CameraHeight

HEIGHT = 1.65
"""Of KITTI's cameras, meters: https://www.cvlibs.net/datasets/kitti/setup.php"""
HEADER = "frames of kitti07 | error of scale | stated | frame to frame | frames with the ground | asked"


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--parts", type=int, nargs="+", default=[160, 80], help="first frames")
    options = parser.parse_args()
    torch.set_num_threads(1)
    (sequence,) = sequences(["kitti07"])
    rows = []
    for stop in options.parts:
        part = sequence.part(0, stop)
        run, view = view_of_run(part)
        found = scale_by(CameraHeight(HEIGHT), view)
        off = scale_error(found, run.trajectory, part.groundtruth)
        rows.append(
            [
                f"1 to {stop}",
                f"{off:+.1%}",
                f"{found.relative_std:.1%}",
                f"{found.apart:.1%}",
                str(found.count),
                "3 %",
            ]
        )
        print(*rows[-1], sep=" | ", flush=True)
    publish(table(HEADER, rows), options, __file__)


if __name__ == "__main__":
    main()
