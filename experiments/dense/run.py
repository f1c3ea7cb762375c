"""How right and how complete is dense depth? A results folder with `dense/` against a sensor or a rendered scene.

python -m experiments.dense.run RESULTS [--depth FOLDER]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import parser_of
from experiments.dense.truth import Sensor, rendered_depth
from torchslam.data import open_sequence
from torchslam.data.synthetic.sequence import SyntheticSequence
from torchslam.dense import DepthMaps
from torchslam.dense.estimate import Estimate, estimate_depth
from torchslam.densify.views import SWEPT, ViewImages, Views, views_of
from torchslam.geometry import se3_inverse
from torchslam.io.results import DEPTHS, MAP, open_run, read_metrics
from torchslam.map.file import read_atlas

LEVELS = (0.01, 0.02, 0.05, 0.1)
BINS = (0.7, 0.8, 0.9, 0.95, 1.0001)


def truth_of(folder: Path, maps: DepthMaps, depth: Path | None) -> Tensor:
    """True depth of maps, map units."""
    if depth is None:
        sequence = open_sequence(read_metrics(folder)["source"])
        if not isinstance(sequence, SyntheticSequence):
            raise SystemExit("give the folder of the sensor's depth with --depth")
        poses = [sequence.pose(index) for index in maps.frame_index.tolist()]
        true = torch.stack([pose for pose in poses if pose is not None])  # a rendered frame has one
        lengths = [torch.pdist(se3_inverse(T_cw.double())[:, :3, 3]).sum() for T_cw in (true, maps.T_cw)]
        return rendered_depth(
            sequence, maps.frame_index.tolist(), maps.camera.size, float(lengths[0] / lengths[1])
        )
    submap = read_atlas(folder / MAP).atlas.main()
    assert submap is not None
    posed = submap.posed_frames
    sensor = Sensor(depth, posed.frames["frame_index"], posed.T_cw(submap.map))
    frames = maps.frame_index.tolist()
    T_cs, meters = sensor.register(frames[::7], maps.depth[::7], maps.T_cw[::7], maps.camera)
    print(f"sensor at {[round(float(x), 4) for x in T_cs[:3, 3]]} m, {meters:.4f} m per map unit")
    return torch.stack(
        [sensor.depth(i, T_cw, maps.camera, T_cs, meters) for i, T_cw in zip(frames, maps.T_cw, strict=True)]
    ).float()


def opened(folder: Path, maps: DepthMaps) -> tuple[Views, ViewImages]:
    """The views that depth maps were computed of, with the default options, and their images."""
    run = open_run(folder)
    assert run.main is not None
    scene = run.scene(run.main, keyframes_alone=True)
    views = views_of(scene, maps.camera.size)
    assert torch.equal(views.frame_index, maps.frame_index), "not the views of the depth maps"
    return views, ViewImages(views, run.images(scene, views.camera))


def estimator(views: Views, images: ViewImages) -> Callable[[int], Estimate]:
    """Depth of a view alone, as `torchslam densify` finds it, before its confidence; cached."""

    @cache
    @torch.no_grad()
    def estimate(view: int) -> Estimate:
        sources = torch.stack([images.gray(other) for other in views.neighbors[view][:SWEPT]])
        poses, limits = views.T_sr(view)[None, :SWEPT], (views.near[view, None], views.far[view, None])
        return estimate_depth(images.gray(view)[None], sources[None], views.camera, poses, *limits)

    return estimate


def add_truth(parser: argparse.ArgumentParser) -> None:
    """Add the folder of results and that of the sensor's depth."""
    parser.add_argument("results", type=Path)
    parser.add_argument("--depth", type=Path, help="folder of the sensor's depth; else the scene is rendered")


def main() -> None:
    parser = parser_of(__doc__)
    add_truth(parser)
    options = parser.parse_args()
    maps = DepthMaps.load(options.results / DEPTHS)
    truth = truth_of(options.results, maps, options.depth)
    known, kept = truth > 0, maps.depth > 0
    error = (maps.depth / torch.where(known, truth, 1.0) - 1).abs()
    both = known & kept
    shares = [float((error[both] < level).double().mean()) for level in LEVELS]
    figures = read_metrics(options.results)["dense"]
    print(
        f"kept: {float(kept.double().mean()):.1%} of all pixels, {float(both.sum() / known.sum()):.1%} with truth"
    )
    print(
        "of those within "
        + ", ".join(f"{level:.0%}: {share:.1%}" for level, share in zip(LEVELS, shares, strict=True))
    )
    print(f"CPU s a map: {figures['cpu_s'] / figures['depth_maps']:.2f}")
    for low, high in pairwise(BINS):
        some = both & (maps.confidence >= low) & (maps.confidence < high)
        if bool(some.any()):
            said, found = float(maps.confidence[some].mean()), float((error[some] < 0.05).double().mean())
            print(
                f"said {said:.1%} within 5 %, {found:.1%} are ({float(some.sum() / both.sum()):.1%} of the kept)"
            )


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
