"""How right is a length between two clicks, and is its stated error? See README.md.

python -m experiments.meters.distances.run RESULTS --depth FOLDER
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from experiments.common import parser_of, publish, table
from experiments.dense.truth import EVERY, Sensor
from experiments.meters.scale import view_of_results
from torchslam.geometry import se3_inverse, transform
from torchslam.metric.distances import Click, Distance, measure_distance
from torchslam.metric.source import ScaleMeasurement, SubmapView

CORNERS = 24
"""Clicks in a frame."""
CLICK_STD_PX = 1.0
LEAST_M = 0.3
"""Shortest length."""
SURE_PX, NEAR_PX = 2, 12
"""Around a click, true depth is the same within the first radius; where it is not in the second, an edge is near."""
SAME = 1.03
"""Range of depth, largest to smallest, of one surface."""
HEADER = (
    "lengths | found | error, median of all | rms | mean | stated, median | within 1 and 2 stated | beyond 4"
)


class Truth(NamedTuple):
    """Clicks of a frame, and what is true of them."""

    frame: int
    pixels: np.ndarray
    points: Tensor
    at_edge: np.ndarray


def registered(view: SubmapView, sensor: Sensor) -> tuple[Tensor, float]:
    """The pose of the sensor on the camera and meters per unit, by the points that frames observe."""
    width, height = view.camera.size
    frames, depths, poses = [], [], []
    observed, slam_map = view.submap.posed_frames.observations, view.submap.map
    for row in range(0, len(view.rows), EVERY):
        own = torch.nonzero(observed["frame_row"] == view.rows[row])[:, 0]
        points_w = slam_map.positions_w[slam_map.follow_merges(observed["point_ids"][own])]
        pixels = observed["pixels"][own].round().long()
        depth = torch.zeros(height, width, dtype=torch.float64)
        depth[pixels[:, 1], pixels[:, 0]] = transform(view.T_cw[row], points_w)[:, 2].double()
        frames.append(int(view.frame_index[row]))
        depths.append(depth.clamp_min(0))
        poses.append(view.T_cw[row].double())
    return sensor.register(frames, torch.stack(depths), torch.stack(poses), view.camera, sample=2)


def true_clicks(view: SubmapView, row: int, depth: np.ndarray) -> Truth:
    """Corners of the image with depth, in map units."""
    assert view.sequence is not None
    frame = int(view.frame_index[row])
    gray = (255 * view.sequence.image(frame)[0, 0].numpy()).astype(np.uint8)
    found = cv2.goodFeaturesToTrack(gray, 4 * CORNERS, 0.03, 20)[:, 0]
    rng = np.random.default_rng(frame)
    found = found[rng.permutation(len(found))]
    known = np.where(depth > 0, depth, np.nan)
    pixels, at_edge, z = [], [], []
    height, width = depth.shape
    for x, y in found.tolist():
        u, v = round(x), round(y)
        if not (NEAR_PX <= u < width - NEAR_PX and NEAR_PX <= v < height - NEAR_PX):
            continue
        near, sure = (known[v - r : v + r + 1, u - r : u + r + 1] for r in (NEAR_PX, SURE_PX))
        if np.isfinite(sure).mean() < 0.7 or np.nanmax(sure) > SAME * np.nanmin(sure):
            continue
        pixels.append((x, y))
        z.append(float(np.nanmedian(sure)))
        at_edge.append(bool(np.isfinite(near).mean() < 0.7 or np.nanmax(near) > 1.1 * np.nanmin(near)))
    clicks = np.array(pixels[:CORNERS]).reshape(-1, 2)
    rays = view.camera.unproject(torch.from_numpy(clicks))
    points_c = rays / rays[:, 2:] * torch.tensor(z[:CORNERS], dtype=torch.float64)[:, None]
    points_w = transform(se3_inverse(view.T_cw[row].double()), points_c)
    return Truth(frame, clicks, points_w, np.array(at_edge[:CORNERS]))


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("results", type=Path)
    parser.add_argument("--depth", type=Path, required=True, help="folder of the sensor's depth images")
    parser.add_argument("--every", type=int, default=50, help="frames from one with clicks to the next")
    options = parser.parse_args()
    torch.set_num_threads(1)
    _, view = view_of_results(options.results)
    sensor = Sensor(options.depth, view.frame_index, view.T_cw)
    T_cs, meters = registered(view, sensor)
    kinds: dict[str, list[tuple[float, float] | None]] = {
        "both ends on surfaces": [],
        "an end near an edge": [],
    }
    for row in range(EVERY, len(view.rows), options.every):
        frame = int(view.frame_index[row])
        depth = sensor.depth(frame, view.T_cw[row], view.camera, T_cs, meters).numpy()
        truth = true_clicks(view, row, depth)
        rng = np.random.default_rng(frame)
        clicked = truth.pixels + CLICK_STD_PX * rng.standard_normal(truth.pixels.shape)
        for one, other in list(pairwise(range(len(truth.pixels))))[::2]:
            length = meters * float((truth.points[one] - truth.points[other]).norm())
            if length < LEAST_M:
                continue
            ends = [Click(frame, (float(clicked[i, 0]), float(clicked[i, 1]))) for i in (one, other)]
            found = measure_distance(view, Distance(ends[0], ends[1], length))
            kind = list(kinds)[int(truth.at_edge[one] or truth.at_edge[other])]
            if isinstance(found, ScaleMeasurement):
                kinds[kind].append((math.log(found.meters_per_unit / meters), found.relative_std))
            else:
                kinds[kind].append(None)
    kinds["all"] = [each for every in list(kinds.values()) for each in every]
    publish(table(HEADER, [_row(name, found) for name, found in kinds.items()]), options, __file__)


def _row(name: str, found: list[tuple[float, float] | None]) -> list[str]:
    """A row of the table; errors are those of the logarithm of the unit."""
    off, std = np.array([each for each in found if each is not None]).T
    whitened = np.abs(off) / std
    return [
        f"{name}: {len(found)}",
        f"{len(off)}",
        f"{np.median(np.abs(off)):.1%}",
        f"{math.sqrt(np.mean(off**2)):.1%}",
        f"{np.mean(off):+.1%}",
        f"{np.median(std):.1%}",
        f"{np.mean(whitened < 1):.0%}, {np.mean(whitened < 2):.0%}",
        f"{np.mean(whitened > 4):.1%}",
    ]


if __name__ == "__main__":
    main()
