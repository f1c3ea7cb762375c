"""Does the cost of a keyframe grow with the size of the map?

    python -m experiments.benchmarks.mapping [--output FILE]

A camera moves along a wall of points, with keyframes of known pose. The next keyframes are mapped, adjusted and checked
for loops, in maps of different sizes, interleaved. Prints a table and writes it to FILE.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from experiments.common import parser_of, publish_page, table
from torchslam.config import Config
from torchslam.geometry import Camera, SharedCamera, transform
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.map.atlas import Atlas
from torchslam.mapping.mapper import Mapper
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures, PoseEstimate
from torchslam.utils.timing import Stopwatch

HERE = Path(__file__).parent
SIZES, NEXT = (200, 1000, 5000), 31
CAMERA = Camera.pinhole(525.0, 525.0, 319.5, 239.5, size=(640, 480))
STEP, SPACING, DEPTH = 0.4, 0.008, 4.0  # meters from keyframe to keyframe, from point to point, to the wall
KEYPOINTS = 1000  # of a keyframe, as the default feature extractor finds
LEVELS, NOISE_PX = 4, 0.5
UNMAPPED = 3  # every so many points of the wall are not in the map: the new keyframes triangulate them


class Walk:
    """A submap of keyframes along a wall, and the stages that process the next ones."""

    def __init__(self, keyframes: int) -> None:
        g = self.generator = torch.Generator().manual_seed(0)
        count = int(((keyframes + NEXT) * STEP + 3 * DEPTH) / SPACING)
        scatter = torch.rand(count, 2, generator=g, dtype=torch.float64) - 0.5
        x = SPACING * torch.arange(count, dtype=torch.float64) - 1.5 * DEPTH
        self.points_w = torch.stack((x, 0.8 * DEPTH * scatter[:, 0], DEPTH + scatter[:, 1]), dim=-1)
        self.descriptors = torch.randint(0, 256, (count, 32), generator=g, dtype=torch.uint8)
        self.scales = 1.2 ** torch.randint(0, LEVELS, (count,), generator=g).double()
        self.rows = torch.full((count,), -1)  # of the points in the map
        self.atlas = Atlas(CAMERA.params)
        self.submap = self.atlas.create()
        self.tracker = Tracker(SharedCamera(CAMERA), Config())
        self.mapper = Mapper(SharedCamera(CAMERA), Config(), Stopwatch())
        for index in range(keyframes):
            self._add(index)
        slam_map = self.submap.map
        for some in torch.arange(keyframes).split(100):
            slam_map.update_appearance(some)
        self.submap.num_cull_checked = keyframes
        self.loop_closer = LoopCloser(SharedCamera(CAMERA), Config(), self.atlas)

    def look(self, index: int) -> tuple[FrameFeatures, Tensor]:
        """The features at a step of the path, and the rows of their points."""
        T_cw = torch.eye(4, dtype=torch.float64)
        T_cw[0, 3] = -index * STEP
        first = int(index * STEP / SPACING)
        near = torch.arange(first, min(first + int(3 * DEPTH / SPACING), len(self.rows)))
        pixels, valid = CAMERA.project(transform(T_cw, self.points_w[near]))
        inside = torch.nonzero(valid & CAMERA.in_image(pixels))[:KEYPOINTS, 0]
        seen, missing = near[inside], KEYPOINTS - len(inside)
        noise = NOISE_PX * torch.randn(len(seen), 2, generator=self.generator, dtype=torch.float64)

        def padded(values: Tensor) -> Tensor:
            return torch.cat([values, values.new_zeros(missing, *values.shape[1:])])

        view = FrameFeatures(
            index,
            float(index),
            padded(pixels[inside] + noise),
            padded(self.scales[seen] - 1) + 1,
            torch.zeros(KEYPOINTS, dtype=torch.float64),
            padded(self.descriptors[seen]),
            torch.arange(KEYPOINTS) < len(seen),
            T_cw,
        )
        return view, seen

    def _add(self, index: int) -> None:
        """Add a keyframe of the initial map with its observations and new points."""
        slam_map = self.submap.map
        view, seen = self.look(index)
        assert view.T_cw_groundtruth is not None
        keyframe = slam_map.add_keyframe(view, view.T_cw_groundtruth)
        new = seen[(self.rows[seen] < 0) & (seen % UNMAPPED > 0)]
        self.rows[new] = slam_map.add_points(self.points_w[new], self.descriptors[new], keyframe)
        at = torch.nonzero(self.rows[seen] >= 0)[:, 0]
        slam_map.add_observations(keyframe, at, self.rows[seen[at]])

    def next(self) -> dict[str, float]:
        """Map the next keyframe; returns the milliseconds of the process by stage."""
        slam_map = self.submap.map
        index = int(slam_map.keyframes["frame_index"][-1]) + 1
        view, seen = self.look(index)
        assert view.T_cw_groundtruth is not None
        known = self.rows[seen] >= 0
        ids = slam_map.follow_merges(self.rows[seen[known]])  # replacements of merged points
        alive = slam_map.points["is_valid"][ids]
        at, ids = torch.nonzero(known)[alive, 0], ids[alive]
        eye = torch.eye(6, dtype=torch.float64)
        estimate = PoseEstimate(view.T_cw_groundtruth, ids, at, len(ids), 1e-6 * eye, DEPTH)
        spent: dict[str, float] = {}

        def timed(stage: str, function: Callable[..., Any], *arguments: Any) -> Any:
            begin = time.process_time()
            answer = function(*arguments)
            spent[stage] = 1e3 * (time.process_time() - begin)
            return answer

        keyframe = timed("mapping, bundle", self.mapper.insert, slam_map, view, estimate)
        timed("loop closer", self.loop_closer.add, slam_map, keyframe)
        timed("local map", self.tracker.reset_to_keyframe, self.submap, keyframe)
        timed("loop detection", self.loop_closer.loop_detector.detect, self.submap, keyframe)
        keys = slam_map.keys
        renumbering = timed("culling, compaction", self.mapper.cull_and_compact, self.submap)
        if renumbering is not None:
            self.loop_closer.remove(keys[renumbering.keyframes < 0])
            self.rows = torch.where(self.rows >= 0, renumbering.points[self.rows], -1)
        at = torch.nonzero(slam_map.keyframes["point_ids"][-1, : len(seen)] >= 0)[:, 0]
        self.rows[seen[at]] = slam_map.keyframes["point_ids"][-1, at]
        return spent


def main() -> None:
    parser = parser_of(__doc__, HERE / "mapping.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with torch.inference_mode():
        walks = {size: Walk(size) for size in SIZES}
        spent: dict[int, list[dict[str, float]]] = {size: [] for size in SIZES}
        for _ in range(NEXT):
            for size, walk in walks.items():
                spent[size].append(walk.next())
    rows = []
    for stage in spent[SIZES[0]][0]:
        ms = [statistics.median(each[stage] for each in spent[size]) for size in SIZES]
        rows.append([stage, *(f"{each:.1f}" for each in ms), f"{ms[-1] / ms[0]:.2f}"])
    header = ["ms of one keyframe", *(f"{size} keyframes" for size in SIZES), f"{SIZES[-1]} / {SIZES[0]}"]
    text = (
        "Simulated: a camera goes along a wall. One thread, "
        f"medians of {NEXT} keyframes, CPU time of the process, the three maps interleaved.\n\n"
        "    python -m experiments.benchmarks.mapping\n\n"
        f"{table(header, rows)}"
    )
    publish_page("A keyframe in a small map and in a large one", text, arguments)


if __name__ == "__main__":
    main()
