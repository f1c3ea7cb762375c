"""Relative pose of real pairs of images, by threshold, beside poselib and OpenCV's MAGSAC, in one run and on one thread.

    python -m experiments.benchmarks.relative_pose [--data FOLDER] [--output FILE] [--pairs 60] [--batched]

FOLDER holds the sequences. Every estimator gets the same matches: ORB, mutual and by ratio, undistorted. The error of a
pair is the larger of those of rotation and of the translation's direction, infinite where an estimator gives no pose.
Pairs whose true baseline is short beside what the ground truth is known to have no true direction and are left out.
Times are CPU time of the thread, so that other work on the machine counts as little as possible, taken in turns with
the peers.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import poselib
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.features import ORB, match
from torchslam.geometry import Camera, estimate_relative_pose, se3_inverse, so3_log
from torchslam.values import Features

HERE = Path(__file__).parent
# Sequences with the least baseline in metres whose direction the ground truth tells, to some degrees: ten times what
# it is good to between frames a second apart.
SEQUENCES = {"redkitchen": 0.1, "kitti07": 0.5, "machine_hall": 0.03, "fr2_desk_20": 0.05, "shelf_bin": 0.02}
GAPS_S = (0.2, 0.4, 0.6, 0.8, 1.0)
THRESHOLDS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
ANGLES = (5, 10, 20)
MIN_MATCHES = 8
CONFIDENCE = 0.9999  # of every estimator


class Pair(NamedTuple):
    """Undistorted pixels (M, 2) of the matches, the true motion T_21 (4, 4), and the camera without distortion."""

    sequence: str
    frames: tuple[int, int]
    pixels_1: Tensor
    pixels_2: Tensor
    T_21: Tensor
    camera: Camera


class Pose(NamedTuple):
    """R (3, 3) and t (3,)."""

    R: NDArray
    t: NDArray


Estimator = Callable[[Pair, float], Pose | None]


def pairs_of(sequence: Sequence, least_baseline: float, count: int) -> list[Pair]:
    """About `count` pairs of a sequence that have a true direction, evenly spread over gaps and time."""
    chosen = []
    for gap_s in GAPS_S:
        gap = max(1, round(gap_s * sequence.frame_rate))
        usable = []
        for first in range(len(sequence) - gap):
            T_1w, T_2w = sequence.pose(first), sequence.pose(first + gap)
            if T_1w is None or T_2w is None:
                continue
            T_21 = T_2w @ se3_inverse(T_1w)
            if float(T_21[:3, 3].norm()) >= least_baseline:
                usable.append((first, first + gap, T_21))
        rows = np.linspace(0, len(usable) - 1, min(len(usable), math.ceil(count / len(GAPS_S)))).astype(int)
        chosen += [usable[row] for row in rows]
    extract, seen = ORB(1000), {}
    for index in sorted({index for first, second, _ in chosen for index in (first, second)}):
        seen[index] = extract(sequence[index].image)
    fx, fy, cx, cy = sequence.camera.params[:4].tolist()
    camera = Camera.pinhole(fx, fy, cx, cy, size=sequence.size)
    pairs = []
    for first, second, T_21 in chosen:
        pixels = [undistorted(x, sequence.camera) for x in matched(seen[first], seen[second])]
        if len(pixels[0]) >= MIN_MATCHES:
            pairs.append(Pair(sequence.name, (first, second), *pixels, T_21.double(), camera))
    return pairs


def matched(first: Features, second: Features) -> tuple[Tensor, Tensor]:
    """Pixels (M, 2) of the matches in both images."""
    matches = match(first, second)
    rows = matches.mask[0]
    pixels_1 = first.keypoints[0][matches.indices_1[0][rows]]
    pixels_2 = second.keypoints[0][matches.indices_2[0][rows]]
    return pixels_1.double(), pixels_2.double()


def undistorted(pixels: Tensor, camera: Camera) -> Tensor:
    """Pixels (M, 2) as the same camera without distortion sees them."""
    camera = camera.to(torch.float64)
    return camera.normalize(pixels) * camera.params[:2] + camera.params[2:4]


# --- estimators ---


def by_torchslam(pair: Pair, threshold: float, **options: Any) -> Pose | None:
    found = estimate_relative_pose(
        pair.pixels_1[None],
        pair.pixels_2[None],
        pair.camera,
        pair.camera,
        threshold,
        confidence=CONFIDENCE,
        **options,
    )
    T_21 = found.T_21[0].numpy()
    return Pose(T_21[:3, :3], T_21[:3, 3]) if bool(found.success[0]) else None


def by_poselib(pair: Pair, threshold: float) -> Pose | None:
    width, height = pair.camera.size
    camera = {"model": "PINHOLE", "width": width, "height": height, "params": pair.camera.params.tolist()}
    ransac = {"max_epipolar_error": threshold, "success_prob": CONFIDENCE, "seed": 0}
    pose, _ = poselib.estimate_relative_pose(
        pair.pixels_1.numpy(), pair.pixels_2.numpy(), camera, camera, ransac, {}
    )
    return Pose(pose.R, pose.t) if np.isfinite(pose.t).all() else None


def by_magsac(pair: Pair, threshold: float) -> Pose | None:
    x_1, x_2, K = pair.pixels_1.numpy(), pair.pixels_2.numpy(), pair.camera.K.numpy()
    cv2.setRNGSeed(0)
    E, mask = cv2.findEssentialMat(x_1, x_2, K, cv2.USAC_MAGSAC, CONFIDENCE, threshold)
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, x_1, x_2, K, mask=mask)
    return Pose(R, t[:, 0])


def error_deg(pose: Pose | None, T_21: Tensor) -> float:
    """The larger of the errors of rotation and direction; infinite without a pose."""
    if pose is None or not np.isfinite(pose.R).all():
        return math.inf
    rotation = float(so3_log(torch.from_numpy(pose.R) @ T_21[:3, :3].mT).norm())
    t, truth = torch.from_numpy(pose.t), T_21[:3, 3]
    direction = float(torch.atan2(torch.linalg.cross(t, truth).norm(), t @ truth))
    return math.degrees(max(rotation, direction))


def area_under_curve(errors: list[float], angle: float) -> float:
    """Percent: the mean over thresholds from 0 to `angle` of the share of errors below them."""
    return 100 * float(np.mean([max(0.0, 1 - error / angle) for error in errors]))


class Outcome(NamedTuple):
    """Of one estimator at one threshold: errors in degrees and CPU milliseconds, per pair."""

    errors: list[float]
    ms: list[float]


def measured(
    pairs: list[Pair], estimators: dict[str, Estimator], thresholds: tuple[float, ...] = THRESHOLDS
) -> dict[tuple[str, float], Outcome]:
    """Every estimator at every threshold, in turns."""
    outcomes = {(name, threshold): Outcome([], []) for name in estimators for threshold in thresholds}
    for pair in pairs:
        for (name, threshold), outcome in outcomes.items():
            begin = time.thread_time()
            pose = estimators[name](pair, threshold)
            outcome.ms.append(1e3 * (time.thread_time() - begin))
            outcome.errors.append(error_deg(pose, pair.T_21))
    return outcomes
