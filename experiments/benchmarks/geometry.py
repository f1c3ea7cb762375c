"""Accuracy and speed of the pose estimators compared with poselib, in one run on one thread.

    python -m experiments.benchmarks.geometry [--peers FOLDER] [--output FILE] [--problems 60]

FOLDER holds `problems.py`, which makes the fixed problems. Times are CPU time of the thread, so that other work on
the machine counts as little as possible, interleaved with the peer. Prints tables and writes them to FILE.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import poselib
import torch
from numpy.typing import NDArray
from torch import Tensor

from experiments.benchmarks.problems import PEERS, load_problems
from experiments.common import milliseconds, parser_of, publish_page, table, timed
from torchslam.geometry import Camera, estimate_absolute_pose, estimate_relative_pose

HERE = Path(__file__).parent
CAMERA = Camera.pinhole(525.0, 525.0, 319.5, 239.5, size=(640, 480))
POSELIB_CAMERA = {"model": "PINHOLE", "width": 640, "height": 480, "params": CAMERA.params.tolist()}
RELATIVE_THRESHOLD, ABSOLUTE_THRESHOLD = 1.0, 2.0
BATCH = 64
relative_of = partial(estimate_relative_pose, camera_1=CAMERA, camera_2=CAMERA, threshold=RELATIVE_THRESHOLD)
absolute_of = partial(estimate_absolute_pose, camera=CAMERA, threshold=ABSOLUTE_THRESHOLD)


class Errors(NamedTuple):
    """Of one estimate: milliseconds, rotation in degrees, translation in degrees of direction or in length."""

    ms: float
    rotation: float
    translation: float


def batch_of_one(*arrays: NDArray) -> list[Tensor]:
    return [torch.from_numpy(array)[None] for array in arrays]


def relative(problems: ModuleType, seed: int, outliers: float) -> tuple[Errors, Errors]:
    """Ours and poselib's, on 500 matches with noise of one pixel."""
    x_1, x_2, R, t, _ = problems.two_view(seed, 500, outliers)

    def errors(ms: float, R_21: NDArray, t_21: NDArray) -> Errors:
        return Errors(ms, problems.rot_err_deg(R, R_21), problems.dir_err_deg(t, t_21, signed=True))

    options = {"max_epipolar_error": RELATIVE_THRESHOLD}
    cameras = POSELIB_CAMERA, POSELIB_CAMERA
    (pose, _), ms = timed(partial(poselib.estimate_relative_pose, x_1, x_2, *cameras, options, {}))
    theirs = errors(ms, pose.R, pose.t)
    found, ms = timed(partial(relative_of, *batch_of_one(x_1, x_2)))
    T_21 = found.T_21[0].numpy()
    return errors(ms, T_21[:3, :3], T_21[:3, 3]), theirs


def absolute(problems: ModuleType, seed: int, outliers: float) -> tuple[Errors, Errors]:
    """Ours and poselib's, on 300 pairs with noise of one pixel."""
    points, pixels, R, t, _ = problems.pnp(seed, 300, outliers)

    def errors(ms: float, R_cw: NDArray, t_cw: NDArray) -> Errors:
        return Errors(ms, problems.rot_err_deg(R, R_cw), float(np.linalg.norm(t - t_cw)))

    options = {"max_reproj_error": ABSOLUTE_THRESHOLD}
    (pose, _), ms = timed(
        partial(poselib.estimate_absolute_pose, pixels, points, POSELIB_CAMERA, options, {})
    )
    theirs = errors(ms, pose.R, pose.t)
    found, ms = timed(partial(absolute_of, *batch_of_one(points, pixels)))
    T_cw = found.T_cw[0].numpy()
    return errors(ms, T_cw[:3, :3], T_cw[:3, 3]), theirs


def plane(problems: ModuleType, seed: int, baseline: float, count: int = 300, outliers: float = 0.3) -> Any:
    """Matches of a slanted plane, noise of one pixel: x_1, x_2, R, t. A baseline of zero is a pure rotation."""
    random = np.random.default_rng(3000 + seed)
    R, t = problems.expm(random.normal(0, 0.08, 3)), random.normal(0, 1, 3) * (1, 1, 0.5)
    t /= np.linalg.norm(t)
    normal, distance = np.array((*random.normal(0, 0.4, 2), 1.0)), random.uniform(3, 5)
    normal /= np.linalg.norm(normal)
    K_inverse, size = np.linalg.inv(problems.K), np.array((problems.W, problems.H))
    x_1: list[NDArray] = []
    x_2: list[NDArray] = []
    while len(x_1) < count:
        pixel = random.uniform((0, 0), size)
        ray = K_inverse @ (*pixel, 1)
        point = ray * distance / (normal @ ray)
        if not 0.5 < point[2] < 30:
            continue
        projected, depth = problems.proj(R, baseline * t, point[None])
        if depth[0] > 0.3 and (projected[0] >= 0).all() and (projected[0] < size).all():
            x_1.append(pixel)
            x_2.append(projected[0])
    noisy_1 = np.array(x_1) + random.normal(0, 1, (count, 2))
    noisy_2 = np.array(x_2) + random.normal(0, 1, (count, 2))
    wrong = int(outliers * count)
    noisy_2[:wrong] = random.uniform((0, 0), size, (wrong, 2))
    return noisy_1, noisy_2, R, t


def models(problems: ModuleType, baseline: float, expected: str, count: int = 50) -> tuple[str, str]:
    """How often the model is right, and what becomes of the poses."""
    seen, ambiguous, errors = Counter[str](), 0, []
    for seed in range(count):
        x_1, x_2, _, t = plane(problems, seed, baseline)
        found = relative_of(*batch_of_one(x_1, x_2))
        seen[found.model[0]] += 1
        ambiguous += int(found.ambiguous.item())
        if found.success.item():
            errors.append(problems.dir_err_deg(t, found.T_21[0, :3, 3].numpy(), signed=True))
    poses = (
        f"{len(errors)} poses, direction off by {np.median(errors):.1f}° (worst {max(errors):.1f}°)"
        if errors
        else "no pose"
    )
    return f"{100 * seen[expected] / count:.0f} %", f"{poses}, {ambiguous} ambiguous"


def speedup(what: str, estimate: Callable[..., Any], cases: list[tuple[NDArray, NDArray]]) -> list[str]:
    """One row: milliseconds per problem in a loop and in one call."""
    stacked = [torch.from_numpy(np.stack(part)) for part in zip(*cases, strict=True)]

    def loop() -> None:
        for case in cases:
            estimate(*batch_of_one(*case))

    def batch() -> None:
        estimate(*stacked)

    one, many = (spent / len(cases) for spent in milliseconds(loop, batch, repeats=3))
    return [what, f"{one:.1f}", f"{many:.1f}", f"{one / many:.1f}"]


def throughput(problems: ModuleType) -> list[list[str]]:
    seeds = range(BATCH)
    return [
        speedup("absolute pose, 30 % outliers", absolute_of, [problems.pnp(s, 300, 0.3)[:2] for s in seeds]),
        speedup("absolute pose, 60 % outliers", absolute_of, [problems.pnp(s, 300, 0.6)[:2] for s in seeds]),
        speedup(
            "relative pose, 40 % outliers", relative_of, [problems.two_view(s, 500, 0.4)[:2] for s in seeds]
        ),
    ]


def compared(what: str, ours: Sequence[Errors], theirs: Sequence[Errors]) -> list[str]:
    """One row: medians and means of ours and the peer's, and their ratios."""
    cells = [what, f"{len(ours)}"]
    for field, digits in (("rotation", 3), ("translation", 4)):
        mine, peer = ([getattr(errors, field) for errors in group] for group in (ours, theirs))
        ratio = statistics.mean(mine) / statistics.mean(peer)
        cells.append(f"{statistics.mean(mine):.{digits}f} / {statistics.mean(peer):.{digits}f} ({ratio:.2f})")
    cells.append(f"{max(errors.rotation for errors in ours):.2f}")
    my_ms, peer_ms = (statistics.median(errors.ms for errors in group) for group in (ours, theirs))
    cells.append(f"{my_ms:.1f} / {peer_ms:.1f} ({my_ms / peer_ms:.2f})")
    return cells


def report(problems: ModuleType, count: int) -> str:
    rows = []
    for what, estimate, fractions in (
        ("relative", relative, (0.1, 0.4, 0.6)),
        ("absolute", absolute, (0.1, 0.3, 0.6)),
    ):
        rows += [
            compared(
                f"{what} pose, {outliers:.0%} outliers",
                *zip(*(estimate(problems, seed, outliers) for seed in range(count)), strict=True),
            )
            for outliers in fractions
        ]
    scenes = [
        [name, *models(problems, baseline, expected)]
        for name, baseline, expected in (("plane", 0.35, "homography"), ("pure rotation", 0.0, "rotation"))
    ]
    parts = [
        "Mean errors and median times, torchslam / poselib (ratio). One thread.\n",
        table("problems | count | rotation, degrees | translation | worst rotation | ms", rows),
        table("scene, 50 of each, 30 % outliers | right model | poses", scenes),
        table(
            f"{BATCH} problems | ms each in a loop | ms each in one call | times faster", throughput(problems)
        ),
    ]
    return "\n".join(parts)


def main() -> None:
    parser = parser_of(__doc__, HERE / "geometry.md")
    parser.add_argument("--peers", type=Path, default=PEERS)
    parser.add_argument("--problems", type=int, default=60, help="how many of each kind")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    text = report(load_problems(arguments.peers), arguments.problems)
    publish_page("Pose estimation compared with poselib", text, arguments)


if __name__ == "__main__":
    main()
