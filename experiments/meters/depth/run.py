"""How right is the scale by depth images, and is its stated error? See README.md.

python -m experiments.meters.depth.run RESULTS --depth FOLDER
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from experiments.common import parser_of, publish, table
from experiments.meters.scale import scale_by, scale_error, view_of_results
from torchslam.data.formats.depth_images import find_depth_images
from torchslam.evaluation import evaluate
from torchslam.metric.sensor_depth import SensorDepth
from torchslam.types import Trajectory

OWN_CAMERA = "585,585,320,240"
"""Of the depth images, which are not registered."""
PARTS = 5
"""Of the recording, each with a scale by the ground truth of its own."""
HEADER = "camera of the depth images | meters per unit | error of scale | stated | image to image | images"


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("results", type=Path)
    parser.add_argument("--depth", type=Path, required=True, help="folder of the sensor's depth images")
    options = parser.parse_args()
    torch.set_num_threads(1)
    sequence, view = view_of_results(options.results)
    trajectory, truth = view.submap.trajectory(view.session), sequence.groundtruth
    assert truth is not None
    images, rows = find_depth_images(options.depth), []
    for name, camera in (("its own, f = 585 px", OWN_CAMERA), ("taken for that of the color images", "")):
        found = scale_by(SensorDepth(images, camera), view)
        rows.append(
            [
                name,
                f"{found.meters_per_unit:.3f}",
                f"{scale_error(found, trajectory, truth):+.1%}",
                f"{found.relative_std:.1%}",
                f"{found.apart:.1%}",
                str(found.count),
            ]
        )
    parts = [
        evaluate(Trajectory(trajectory.timestamps[part], trajectory.T_wc[part]), truth).scale
        for part in np.array_split(np.arange(len(trajectory)), PARTS)
    ]
    scale, of_parts = evaluate(trajectory, truth).scale, ", ".join(f"{each:.3f}" for each in parts)
    print(f"meters per unit by the ground truth: {scale:.3f}; of {PARTS} parts {of_parts}")
    publish(table(HEADER, rows), options, __file__)


if __name__ == "__main__":
    main()
