"""Dense depth beside OpenCV's StereoSGBM and a plane sweep of squared differences, on the same views.

python -m experiments.dense.peers RESULTS [--depth FOLDER] [--first N]

Poses, images, ranges of depth, neighbors and the comparison of the views are the same for all. A peer has no confidence
of its own: that of its fused depth is a logistic model fitted to half of the truth that it is measured on, which favors
it. `torchslam densify` must have been run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import cache
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from experiments.dense.fit import fit
from experiments.dense.run import LEVELS, opened, truth_of
from torchslam.dense import DepthMaps
from torchslam.dense.confidence import (
    LEAST_KEPT,
    confidence_alone,
    confidence_together,
    kept,
    together_features,
)
from torchslam.dense.consistency import merge
from torchslam.dense.cost_volume import box_sum, find_minimum, inverse_depth_planes, mean_of_best, warp
from torchslam.dense.estimate import BEST_VIEWS, FULL_RADIUS, PLANES, estimate_depth
from torchslam.densify.views import SWEPT, ViewImages, Views
from torchslam.geometry import se3_inverse
from torchslam.io.results import DEPTHS

PAIRS = 6  # of a view that SGBM matches
SIDEWAYS = 0.7  # sine of the angle of baseline and optical axis from which on a pair is rectified
BLOCK_SIZE = 5
CONSTANT = 0.9  # confidence of a peer's depth alone
PLANES_AT_ONCE = 8
SAMPLE = 9  # every so many pixels are fitted
RIGHT = 0.05


class Rectified(NamedTuple):
    """A view and a neighbor on its right after a rotation of both.

    Attributes:
        R: from the camera of the view, and from that of the neighbor, to the rectified ones.
        K: of both rectified cameras.
        size: of both images.
        baseline: map units.
    """

    R: tuple[np.ndarray, np.ndarray]
    K: np.ndarray
    size: tuple[int, int]
    baseline: float


def rectify(views: Views, view: int, other: int) -> Rectified | None:
    """Rectify by rotations (Fusiello 2000), whatever the direction of the baseline; None along the optical axis.

    `cv2.stereoRectify` does the same for baselines that are nearly horizontal or vertical.
    """
    T_wr, T_ws = (se3_inverse(views.T_cw[each]).double().numpy() for each in (view, other))
    offset = T_ws[:3, 3] - T_wr[:3, 3]
    baseline = float(np.linalg.norm(offset))
    x = offset / baseline
    z = T_wr[:3, 2] + T_ws[:3, 2]
    z = z / np.linalg.norm(z)
    across = z - x * (x @ z)
    if np.linalg.norm(across) < SIDEWAYS:
        return None
    z = across / np.linalg.norm(across)
    axes = np.stack((x, np.cross(z, x), z))
    R = (axes @ T_wr[:3, :3], axes @ T_ws[:3, :3])
    K = views.camera.K.double().numpy().copy()
    width, height = views.camera.size
    corners = np.array(((0, 0, 1), (width - 1, 0, 1), (0, height - 1, 1), (width - 1, height - 1, 1.0)))
    rays = R[0] @ np.linalg.inv(K) @ corners.T
    focal = (K[0, 0] + K[1, 1]) / 2
    if rays[2].min() < 0.3:  # the image would become very large
        return None
    at = focal * rays[:2] / rays[2]
    low, size = at.min(1), np.ceil(at.max(1) - at.min(1)).astype(int) + 1
    K_rectified = np.array(((focal, 0, -low[0]), (0, focal, -low[1]), (0, 0, 1.0)))
    return Rectified(R, K_rectified, (int(size[0]), int(size[1])), baseline)


def sgbm(views: Views, images: ViewImages, view: int, other: int) -> Float[Tensor, "H W"] | None:
    """Inverse depth of a view from one neighbor, 0 where unknown; None if the pair cannot be rectified."""
    pair = rectify(views, view, other)
    if pair is None:
        return None
    K = views.camera.K.double().numpy()
    width, height = views.camera.size
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = np.stack((x, y, np.ones_like(x)), -1) @ np.linalg.inv(K).T @ pair.R[0].T
    near, far = float(views.near[view]), float(views.far[view])
    scale = pair.K[0, 0] * pair.baseline  # disparity times depth
    low = int(np.floor(scale / (far * rays[..., 2].max())))
    high = int(np.ceil(scale / (near * rays[..., 2].min())))
    count = (high - low + 15) // 16 * 16
    # The left image is widened by the disparities: SGBM finds none near its left edge.
    size = (pair.size[0] + low + count, pair.size[1])
    K_wide = pair.K.copy()
    K_wide[0, 2] += low + count
    rectified = []
    for each, R in zip((view, other), pair.R, strict=True):
        gray = (images.gray(each).numpy() * 255).round().astype(np.uint8)
        maps = cv2.initUndistortRectifyMap(K, np.zeros(5), R, K_wide, size, cv2.CV_32FC1)
        rectified.append(cv2.remap(gray, *maps, cv2.INTER_LINEAR))
    matcher = cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=count,
        blockSize=BLOCK_SIZE,
        P1=8 * BLOCK_SIZE**2,
        P2=32 * BLOCK_SIZE**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=50,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    disparity = matcher.compute(*rectified).astype(np.float32) / 16
    is_known = (disparity >= low) & (disparity > 0)
    at = (rays @ K_wide.T).astype(np.float32)
    places = np.ascontiguousarray(at[..., 0] / at[..., 2]), np.ascontiguousarray(at[..., 1] / at[..., 2])
    disparity = np.where(is_known, disparity, 0)
    nearest = cv2.remap(disparity, *places, cv2.INTER_NEAREST)
    between = cv2.remap(disparity, *places, cv2.INTER_LINEAR)
    # Between pixels of one surface, which have a disparity all four.
    found = np.where((nearest > 0) & (np.abs(between - nearest) < 1), between, nearest)
    return torch.from_numpy(found * rays[..., 2] / scale).float()


def squared_differences(views: Views, images: ViewImages, view: int) -> Float[Tensor, "H W"]:
    """Inverse depth of the plane of the least squared differences, of the views that match best."""
    sources = torch.stack([images.gray(other) for other in views.neighbors[view][:SWEPT]])
    reference, T_sr = images.gray(view), views.T_sr(view)[:SWEPT]
    planes = inverse_depth_planes(views.near[view], views.far[view], PLANES).float()
    costs = []
    for some in planes.split(PLANES_AT_ONCE):
        samples, is_seen = warp(sources, views.camera, T_sr, some[:, None, None])
        cost = box_sum((samples - reference).square(), FULL_RADIUS) / box_sum(
            torch.ones_like(reference), FULL_RADIUS
        )
        scores = torch.where(is_seen, -cost, -1.0)
        costs.append(-mean_of_best(scores, min(BEST_VIEWS, len(sources))))
    return planes[0] + (planes[1] - planes[0]) * find_minimum(torch.cat(costs)).position


class Depth(NamedTuple):
    """Inverse depth of views, 0 where unknown, confidence, features that it may be fitted to, and CPU seconds."""

    inverse_depth: Float[Tensor, "K H W"]
    confidence: Float[Tensor, "K H W"]
    features: Float[Tensor, "K H W 4"] | None
    seconds: float


def fused(views: Views, rows: list[int], alone: Callable[[int], tuple[Tensor, Tensor]]) -> Depth:
    """Depth of some views after the comparison with their neighbors; seconds are those of the comparison."""
    found, confidences, features, seconds = [], [], [], 0.0
    for view in rows:
        others = [alone(other) for other in views.neighbors[view]]
        depth, confidence = alone(view)
        started = time.process_time()
        depths, weights = (torch.stack([each[i] for each in others]) for i in (0, 1))
        merged = merge(depth, confidence, depths, weights, views.camera, views.T_sr(view))
        found.append(merged.inverse_depth)
        confidences.append(confidence_together(merged, confidence))
        seconds += time.process_time() - started
        features.append(together_features(merged, confidence))
    return Depth(torch.stack(found), torch.stack(confidences), torch.stack(features), seconds)


def with_fitted_confidence(depth: Depth, truth: Float[Tensor, "K H W"]) -> Depth:
    """Confidence by a model fitted to every few pixels with truth and depth."""
    assert depth.features is not None
    place = torch.nonzero(((truth > 0) & (depth.inverse_depth > 0)).flatten())[::SAMPLE, 0]
    features = depth.features.flatten(0, -2).double()
    # A constant confidence makes the view's own log-odds a multiple of whether it agrees: 0 or not.
    is_right = (1 / (depth.inverse_depth * truth)).flatten()[place].sub(1).abs() < RIGHT
    weights = fit([features[place]], [is_right.double()])
    odds = features @ torch.tensor(weights[:-1], dtype=torch.float64) + weights[-1]
    confidence = torch.sigmoid(odds).float().reshape(truth.shape)
    return depth._replace(confidence=torch.where(depth.inverse_depth > 0, confidence, 0.0))


def kept_at(depth: Depth, truth: Float[Tensor, "K H W"], share: float) -> float:
    """The most of the pixels with truth that can be kept, by confidence, with so many of them within 5 %."""
    known = (truth > 0) & (depth.inverse_depth > 0) & (depth.confidence > 0)
    is_right = (1 / (depth.inverse_depth[known] * truth[known]) - 1).abs() < RIGHT
    order = depth.confidence[known].argsort(descending=True)
    shares = is_right[order].double().cumsum(0) / torch.arange(1, len(order) + 1)
    enough = torch.nonzero(shares >= share)
    return (int(enough[-1, 0]) + 1) / int((truth > 0).sum()) if len(enough) else 0.0


def row_of(name: str, depth: Depth, is_kept: Tensor, truth: Tensor, seconds: float) -> float:
    """Print a row of the table; return the share within 5 %."""
    both = is_kept & (truth > 0) & (depth.inverse_depth > 0)
    wrong = (1 / (depth.inverse_depth[both] * truth[both]) - 1).abs()
    shares = [float((wrong < level).double().mean()) for level in LEVELS]
    cells = [float(both.sum() / (truth > 0).sum()), *shares]
    print(f"| {name} | {' | '.join(f'{each:.1%}' for each in cells)} | {seconds:.2f} |", flush=True)
    return shares[LEVELS.index(RIGHT)]


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument(
        "--depth", type=Path, help="folder of the sensor's depth images; else the scene is rendered"
    )
    parser.add_argument("--first", type=int, help="measure the first so many views (default: all)")
    options = parser.parse_args()
    maps = DepthMaps.load(options.results / DEPTHS)
    views, images = opened(options.results, maps)
    rows = list(range(len(views)))[: options.first]
    with torch.enable_grad():  # the sensor's pose is found by gradients
        truth = truth_of(options.results, maps, options.depth)[rows]
    seconds: dict[str, list[float]] = {"ours": [], "sgbm": [], "ssd": []}  # of each view alone

    def timed(
        name: str, alone: Callable[[int], tuple[Tensor, Tensor]]
    ) -> Callable[[int], tuple[Tensor, Tensor]]:
        @cache
        def called(view: int) -> tuple[Tensor, Tensor]:
            for each in (view, *views.neighbors[view]):
                images.color(each)
            started = time.process_time()
            found = alone(view)
            seconds[name].append(time.process_time() - started)
            return found

        return called

    def ours(view: int) -> tuple[Tensor, Tensor]:
        sources = torch.stack([images.gray(other) for other in views.neighbors[view][:SWEPT]])
        limits = views.near[view, None], views.far[view, None]
        poses = views.T_sr(view)[None, :SWEPT]
        found = estimate_depth(images.gray(view)[None], sources[None], views.camera, poses, *limits)
        return found.inverse_depth[0], confidence_alone(found)[0]

    def constant(depth: Tensor) -> tuple[Tensor, Tensor]:
        return depth, CONSTANT * (depth > 0).float()

    def pair_maps(view: int, count: int) -> list[Tensor]:
        found = (sgbm(views, images, view, other) for other in views.neighbors[view])
        unknown = torch.zeros(views.camera.size[::-1])
        return list(islice((each for each in found if each is not None), count)) or [unknown]

    def pairs(view: int) -> tuple[Tensor, Tensor]:
        depth = torch.stack(pair_maps(view, PAIRS))
        weights, same = CONSTANT * (depth > 0).float(), torch.eye(4).expand(len(depth) - 1, 4, 4)
        if len(depth) == 1:
            return depth[0], weights[0]
        return constant(merge(depth[0], weights[0], depth[1:], weights[1:], views.camera, same).inverse_depth)

    print(
        f"{len(rows)} of {len(views)} views, {views.camera.size[0]} x {views.camera.size[1]}; seconds are CPU"
    )
    print("| | kept | within 1 % | 2 % | 5 % | 10 % | s a map |\n|---|---|---|---|---|---|---|")
    started = time.process_time()
    one = torch.cat([torch.stack(pair_maps(view, 1)) for view in rows])
    single = Depth(one, (one > 0).float(), None, time.process_time() - started)
    targets = {"SGBM, one pair": row_of("SGBM, one pair", single, one > 0, truth, single.seconds / len(rows))}
    found = {}
    for name, key, alone in (
        ("SGBM, fused", "sgbm", pairs),
        ("torchslam", "ours", ours),
        (
            "squared differences, fused",
            "ssd",
            lambda view: constant(squared_differences(views, images, view)),
        ),
    ):
        depth = fused(views, rows, timed(key, alone))
        depth = depth if key == "ours" else with_fitted_confidence(depth, truth)
        is_kept = torch.stack([kept(each) for each in depth.confidence])
        found[name] = depth
        cost = sum(seconds[key]) / len(seconds[key]) + depth.seconds / len(rows)
        targets[f"{name}"] = row_of(f"{name}, confidence at least {LEAST_KEPT}", depth, is_kept, truth, cost)
        if key == "ours":
            found[f"{name}, fitted alike"] = with_fitted_confidence(depth, truth)
        else:
            row_of(f"{name}, all", depth, depth.confidence > 0, truth, cost)
    print("\n| within 5 % | " + " | ".join(found) + " | torchslam / SGBM |\n|---|---|---|---|---|")
    for name, share in (*targets.items(), *((f"{each:.0%}", each) for each in (0.8, 0.85, 0.9, 0.95, 0.99))):
        cells = {each: kept_at(depth, truth, share) for each, depth in found.items()}
        ratio = cells["torchslam"] / max(cells["SGBM, fused"], 1e-9)
        said = f"{share:.1%} ({name})" if "%" not in name else name
        print(f"| {said} | {' | '.join(f'{each:.1%}' for each in cells.values())} | {ratio:.2f} |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
