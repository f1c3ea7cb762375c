"""Keypoint noise of a feature extractor, from the residuals of whole runs. See README.md.

    python -m experiments.front_ends.noise shelf_bin fr2_desk_20 --front-ends orb xfeat aliked

The residuals are those of keyframes in the final map. Points with few observations follow the noise, so only points
with four or more count, and the degrees of freedom are corrected. The noise follows from the median squared error,
assuming a chi-square distribution with two degrees of freedom, so that outliers do not matter.
"""

from __future__ import annotations

import math

import torch

from experiments.common import add_weights, parser_of, sequences, table
from experiments.front_ends.run import FRONT_ENDS, NAMES, overrides
from torchslam import SLAM, load_config
from torchslam.geometry import squared_reprojection_errors, transform
from torchslam.optim.run_graph import ObservationGraph

LEAST_VIEWS = 4
MEDIAN = 2 * math.log(2)  # of a chi-square distribution of two degrees of freedom


def noise_px(graph: ObservationGraph, scales: torch.Tensor) -> tuple[float, float]:
    """The noise in pixels, and in scales (O,) of the keypoints, by the observations of keyframes."""
    by_keyframe = graph.is_keyframe[graph.frame_index]
    views = torch.bincount(graph.point_index[by_keyframe], minlength=len(graph.points_w))
    rows = by_keyframe & (views[graph.point_index] >= LEAST_VIEWS)
    points_c = transform(
        graph.T_cw[graph.frame_index[rows]], graph.points_w[graph.point_index[rows]][:, None]
    )
    squared = squared_reprojection_errors(points_c[:, 0], graph.pixels[rows], graph.camera)
    squared = squared / (1 - 1.5 / views[graph.point_index[rows]])  # 3 of 2 n numbers went into the point
    in_scales = (squared / scales[rows] ** 2).median()
    return float((squared.median() / MEDIAN).sqrt()), float((in_scales / MEDIAN).sqrt())


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument(
        "--front-ends", nargs="*", default=["orb", "xfeat", "aliked"], choices=list(FRONT_ENDS)
    )
    add_weights(parser)
    parser.add_argument("--limit", type=int, default=120, help="frames of each sequence")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.names:
        for kind in arguments.front_ends:
            settings = overrides(kind, arguments.weights)
            if settings is None:
                continue
            for sequence in sequences([name]):
                part = sequence.part(0, min(arguments.limit, len(sequence)))
                run = SLAM(part.camera, load_config(None, settings)).run(part)
                if run.main is None:
                    rows.append([name, kind, "no map", "", ""])
                    continue
                graph = run.main.posed_frames.graph(run.map, run.sensor)
                seen = graph.frame_index.clamp(max=run.map.num_keyframes - 1)
                scales = run.map.keyframes["scales"][seen, graph.keypoint_index]
                px, in_scales = noise_px(graph, scales)
                rows.append([name, kind, str(len(run.trajectory)), f"{px:.2f}", f"{in_scales:.2f}"])
                print(*rows[-1], sep="\t", flush=True)
    print(table(["sequence", "feature extractor", "posed", "noise (px)", "noise (scales)"], rows))


if __name__ == "__main__":
    main()
