"""Relative pose of real pairs of images, by threshold, compared with poselib and OpenCV's MAGSAC.

    python -m experiments.benchmarks.relative_pose [--data FOLDER] [--output FILE] [--pairs 60] [--seeds 3]

FOLDER holds the sequences; about so many pairs are taken of each. What is drawn at random decides over tenths of a
percent: every estimator runs with several seeds, each with the matches in another order, and the table has the means
and their standard deviations over the seeds. Every estimator gets the same matches: ORB, mutual
and by ratio, undistorted. The error of a pair is the larger of those of rotation and of the translation's direction,
infinite where an estimator gives no pose; "auto" gives one where it says `success`, the others almost always. "auto,
else essential" takes that of the essential matrix where it does not.
Pairs whose baseline is not much longer than the error of the ground truth have no true direction and are excluded.
Times are CPU time of the thread, so that other work on the machine counts as little as possible; peers are interleaved.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import poselib
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from experiments.benchmarks.problems import match_pixels
from experiments.common import DATA_DIR, parser_of, publish_page, table
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.features import ORB
from torchslam.geometry import Camera, estimate_relative_pose, se3_inverse, so3_log
from torchslam.geometry.relative_pose import Model

HERE = Path(__file__).parent
# Sequences with the least baseline in meters whose direction the ground truth determines to some degrees: several times
# what it is good to.
SEQUENCES = {"redkitchen": 0.1, "kitti07": 0.5, "machine_hall": 0.03, "fr2_desk_20": 0.05, "shelf_bin": 0.02}
GAPS_S = (0.2, 0.4, 0.6, 0.8, 1.0)
THRESHOLDS = (0.5, 1.0, 2.0, 4.0)
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


Estimator = Callable[[Pair, float, int], Pose | None]


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
        pixels_1, pixels_2 = (
            undistorted(pixels, sequence.camera) for pixels in match_pixels(seen[first], seen[second])
        )
        if len(pixels_1) >= MIN_MATCHES:
            pairs.append(Pair(sequence.name, (first, second), pixels_1, pixels_2, T_21.double(), camera))
    return pairs


def undistorted(pixels: Tensor, camera: Camera) -> Tensor:
    """Pixels (M, 2) as the same camera without distortion sees them."""
    camera = camera.to(torch.float64)
    return camera.normalize(pixels) * camera.params[:2] + camera.params[2:4]


def in_another_order(pair: Pair, seed: int) -> Pair:
    """The same matches; of OpenCV's estimator, whose seed cannot be chosen, the order decides what is drawn."""
    order = torch.randperm(len(pair.pixels_1), generator=torch.Generator().manual_seed(seed))
    return pair._replace(pixels_1=pair.pixels_1[order], pixels_2=pair.pixels_2[order])


# --- estimators ---


def by_torchslam(pair: Pair, threshold: float, seed: int, model: Model, always: bool = False) -> Pose | None:
    """always: the pose of the essential matrix where there is no success, instead of none"""
    found = estimate_relative_pose(
        pair.pixels_1[None],
        pair.pixels_2[None],
        camera_1=pair.camera,
        camera_2=pair.camera,
        threshold=threshold,
        seed=seed,
        confidence=CONFIDENCE,
        model=model,
    )
    success = bool(found.success[0])
    if not success and model == "auto" and not always:
        return None
    T_21 = (found.T_21 if success else found.T_21_essential)[0].numpy()
    return Pose(T_21[:3, :3], T_21[:3, 3])


def batched_ms(pairs: list[Pair], threshold: float, model: Model) -> float:
    """CPU milliseconds per pair where all those of one camera go in one call."""
    spent = 0.0
    for _, group in groupby(pairs, lambda pair: pair.sequence):
        members = list(group)
        pixels_1, pixels_2 = (
            pad_sequence(side, batch_first=True, padding_value=math.nan)
            for side in ([pair.pixels_1 for pair in members], [pair.pixels_2 for pair in members])
        )
        camera = members[0].camera
        begin = time.thread_time()
        estimate_relative_pose(
            pixels_1,
            pixels_2,
            camera_1=camera,
            camera_2=camera,
            threshold=threshold,
            confidence=CONFIDENCE,
            model=model,
        )
        spent += time.thread_time() - begin
    return 1e3 * spent / len(pairs)


def by_poselib(pair: Pair, threshold: float, seed: int) -> Pose | None:
    width, height = pair.camera.size
    camera = {"model": "PINHOLE", "width": width, "height": height, "params": pair.camera.params.tolist()}
    ransac = {"max_epipolar_error": threshold, "success_prob": CONFIDENCE, "seed": seed}
    pose, _ = poselib.estimate_relative_pose(
        pair.pixels_1.numpy(), pair.pixels_2.numpy(), camera, camera, ransac, {}
    )
    return Pose(pose.R, pose.t) if np.isfinite(pose.t).all() else None


def by_magsac(pair: Pair, threshold: float, seed: int) -> Pose | None:
    x_1, x_2, K = pair.pixels_1.numpy(), pair.pixels_2.numpy(), pair.camera.K.numpy()
    cv2.setRNGSeed(seed)
    E, mask = cv2.findEssentialMat(x_1, x_2, K, cv2.USAC_MAGSAC, CONFIDENCE, threshold)
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, x_1, x_2, K, mask=mask)
    return Pose(R, t[:, 0])


def error_deg(pose: Pose | None, T_21: Tensor) -> float:
    """The larger of the errors of rotation and direction; infinite without a pose."""
    if pose is None or not pose.t.any():
        return math.inf
    rotation = float(so3_log(torch.tensor(pose.R) @ T_21[:3, :3].mT).norm())
    t, truth = torch.tensor(pose.t), T_21[:3, 3]
    direction = float(torch.atan2(torch.linalg.cross(t, truth).norm(), t @ truth))
    return math.degrees(max(rotation, direction))


def area_under_curve(errors: list[float], angle: float) -> float:
    """Percent: the mean over thresholds from 0 to `angle` of the share of errors below them."""
    return 100 * float(np.mean([max(0.0, 1 - error / angle) for error in errors]))


class Outcome(NamedTuple):
    """Of one estimator at one threshold: errors in degrees, per seed and pair, and CPU milliseconds."""

    errors: list[list[float]]
    ms: list[float]

    def areas(self) -> str:
        """The areas under the curve, mean and standard deviation over the seeds."""
        cells = []
        for angle in ANGLES:
            areas = [area_under_curve(errors, angle) for errors in self.errors]
            spread = f" ± {statistics.stdev(areas):.1f}" if len(areas) > 1 else ""
            cells.append(f"{statistics.mean(areas):.1f}{spread}")
        return " / ".join(cells)


def measured(
    pairs: list[Pair], estimators: dict[str, Estimator], seeds: int
) -> dict[tuple[str, float], Outcome]:
    """Every estimator at every threshold, interleaved."""
    outcomes = {(name, threshold): Outcome([], []) for name in estimators for threshold in THRESHOLDS}
    for seed in range(seeds):
        for outcome in outcomes.values():
            outcome.errors.append([])
        for pair in pairs:
            shuffled = in_another_order(pair, seed)
            for (name, threshold), outcome in outcomes.items():
                begin = time.thread_time()
                pose = estimators[name](shuffled, threshold, seed)
                outcome.ms.append(1e3 * (time.thread_time() - begin))
                outcome.errors[-1].append(error_deg(pose, pair.T_21))
    return outcomes


def report(pairs: list[Pair], seeds: int) -> str:
    estimators: dict[str, Estimator] = {
        "torchslam, auto": partial(by_torchslam, model="auto"),
        "torchslam, auto, else essential": partial(by_torchslam, model="auto", always=True),
        "torchslam, essential": partial(by_torchslam, model="essential"),
        "poselib": by_poselib,
        "OpenCV MAGSAC": by_magsac,
    }
    outcomes = measured(pairs, estimators, seeds)
    names = [f"{name} {len(list(group))}" for name, group in groupby(pair.sequence for pair in pairs)]
    thresholds = [f"{threshold:g}" for threshold in THRESHOLDS]
    areas = [[name, *(outcomes[name, each].areas() for each in THRESHOLDS)] for name in estimators]
    times = []
    for name in estimators:
        spent = [outcomes[name, threshold].ms for threshold in THRESHOLDS]
        times.append([name, *(f"{statistics.mean(ms):.1f}, {statistics.median(ms):.1f}" for ms in spent)])
    models: tuple[Model, ...] = ("auto", "essential")
    for model in models:
        cells = [f"{batched_ms(pairs, threshold, model):.1f}" for threshold in THRESHOLDS]
        times.append([f"torchslam, {model}, one call per sequence", *cells])
    parts = [
        f"{len(pairs)} pairs ({', '.join(names)}), {', '.join(map(str, GAPS_S))} s apart; AUC at "
        f"{', '.join(map(str, ANGLES))} degrees, percent, mean and standard deviation over {seeds} seeds. One "
        "thread.\n",
        table(["threshold, px", *thresholds], areas),
        table(["CPU ms per pair: mean, median", *thresholds], times),
    ]
    return "\n".join(parts)


def main() -> None:
    parser = parser_of(__doc__, HERE / "relative_pose.md")
    parser.add_argument("--data", type=Path, default=DATA_DIR)
    parser.add_argument("--pairs", type=int, default=60, help="of images, per sequence")
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    with torch.no_grad():
        pairs: list[Pair] = []
        for name, least_baseline in SEQUENCES.items():
            pairs += pairs_of(open_sequence(arguments.data / name), least_baseline, arguments.pairs)
        text = report(pairs, arguments.seeds)
    publish_page("Relative pose of real pairs", text, arguments)


if __name__ == "__main__":
    main()
