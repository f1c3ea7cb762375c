"""Learn the descriptor's 256 tests and write them to torchslam/features/pattern.py.

    python -m experiments.benchmarks.learn_pattern [--data DIR]

Corners are detected in images and in warped copies of them; pairs that the warp confirms are matches, others are not.
Out of random tests a greedy search picks, one after the other, the test that most increases the separation

    (mean distance of non-matches - mean distance of matches) / sqrt(variance of both)

of the summed Hamming distance: tests that are stable, balanced and say something new. The images are those of sequences
that the benchmark does not measure on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.features import ORB, brief
from torchslam.features.brief import blur, orientations, sample_rotated

SEQUENCES = ("machine_hall", "fr2_desk_20", "standstill")
IMAGES_EACH = {"machine_hall": 24, "fr2_desk_20": 20, "standstill": 2}
WARPS_EACH = 3
CANDIDATES = 8000
PAIRS = 8000
TESTS = 256
RADIUS = 14


def grid_points() -> tuple[tuple[int, int], ...]:
    """All whole pixels of the disk."""
    axis = range(-RADIUS, RADIUS + 1)
    return tuple((x, y) for y in axis for x in axis if x * x + y * y <= (RADIUS + 0.5) ** 2)


def random_warp(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A homography: rotation by up to a whole turn, scale 0.6 to 1.4, some shear and perspective."""
    angle, scale = (
        rng.uniform(-np.pi, np.pi) * rng.choice([0.1, 1.0]),
        np.exp(rng.uniform(np.log(0.6), np.log(1.4))),
    )
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    affine = scale * rotation @ (np.eye(2) + rng.normal(0, 0.08, (2, 2)))
    centre = np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1.0]])
    middle = np.eye(3)
    middle[:2, :2] = affine
    middle[2, :2] = rng.normal(0, 2e-4, 2)
    return centre @ middle @ np.linalg.inv(centre)


def warped(image: np.ndarray, warp: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The image seen through the warp, with another exposure, blur and noise."""
    shrink = np.sqrt(abs(np.linalg.det(warp[:2, :2])))
    if shrink < 1:
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / shrink**2 - 1) + 1e-3)
    out: np.ndarray = cv2.warpPerspective(image, warp, image.shape[::-1]).astype(np.float64)
    if rng.random() < 0.5:
        out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.3, 1.5))
    out = out * rng.uniform(0.6, 1.3) + rng.uniform(-20, 20) + rng.normal(0, rng.uniform(0, 8), out.shape)
    return np.clip(out, 0, 255).astype(np.uint8)


def samples(orb: ORB, image: np.ndarray) -> tuple[np.ndarray, Tensor, Tensor]:
    """Keypoints (N, 2) and their levels (N,), and the blurred values (N, K) int16 at all grid points."""
    corners = orb.detect(torch.from_numpy(image).float()[None, None] / 255)
    stride = corners.atlas.stride
    angles = orientations(corners.pixels, corners.positions, stride)
    values = sample_rotated(blur(corners.pixels, stride), corners.positions, angles, stride, grid_points())
    scale = torch.tensor(corners.atlas.scales)[corners.level]
    return ((corners.xy + 0.5) * scale - 0.5).numpy(), corners.level, values


def matching_samples(data: Path, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Blurred values (P, K) around the same corners in two views."""
    orb = ORB(num_keypoints=1500)
    firsts, seconds = [], []
    for name in SEQUENCES:
        paths = sorted((data / name / "rgb").iterdir())
        for path in paths[:: max(1, len(paths) // IMAGES_EACH[name])]:
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise SystemExit(f"{path}: cannot be read")
            keypoints, level, values = samples(orb, image)
            for _ in range(WARPS_EACH):
                warp = random_warp(rng, *image.shape)
                keypoints_2, level_2, values_2 = samples(orb, warped(image, warp, rng))
                moved = np.c_[keypoints, np.ones(len(keypoints))] @ warp.T
                moved = moved[:, :2] / moved[:, 2:]
                apart = torch.from_numpy(np.linalg.norm(moved[:, None] - keypoints_2[None], axis=-1))
                # The same corner: less than 1.5 pixels of its level apart, on a level that sees it as large.
                shrink = np.log(abs(np.linalg.det(warp[:2, :2]))) / 2 / np.log(orb.scale_factor)
                apart = apart / orb.scale_factor ** level_2.double()
                apart = apart + 10 * ((level[:, None] + shrink - level_2[None]).abs() > 0.8)
                nearest = apart.min(1)
                rows = (nearest.values < 1.5).nonzero().squeeze(1)
                firsts.append(values[rows])
                seconds.append(values_2[nearest.indices[rows]])
    first, second = torch.cat(firsts), torch.cat(seconds)
    chosen = torch.from_numpy(rng.permutation(len(first))[:PAIRS])
    return first[chosen], second[chosen]


def random_tests(rng: np.random.Generator) -> np.ndarray:
    """(CANDIDATES, 2) different pairs of grid points, denser towards the middle."""
    points = np.array(grid_points())
    weight = np.exp(-(points**2).sum(1) / (2 * 12.0**2))
    pairs = rng.choice(len(points), (3 * CANDIDATES, 2), p=weight / weight.sum())
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    different = np.unique(np.sort(pairs[apart >= 2], axis=1), axis=0)
    return different[rng.permutation(len(different))[:CANDIDATES]]


def greedy_search(first: Tensor, second: Tensor, tests: Tensor) -> list[int]:
    """Rows of `tests` (T, 2) that together separate matches (row p with row p) from others (row p with row p + 1)."""
    bits = [values[:, tests[:, 0]] < values[:, tests[:, 1]] for values in (first, second)]
    same = (bits[0] ^ bits[1]).T.to(torch.float32).contiguous()  # (T, P): does the test differ
    other = (bits[0] ^ bits[1].roll(1, 0)).T.to(torch.float32).contiguous()
    gain = other.mean(1) - same.mean(1)
    same, other = same - same.mean(1, keepdim=True), other - other.mean(1, keepdim=True)
    variance = (same.square() + other.square()).mean(1)
    covariance = torch.zeros(len(tests))  # with the sum of the tests chosen so far
    total_gain = total_variance = 0.0
    chosen: list[int] = []
    for _ in range(TESTS):
        separation = (total_gain + gain) / (total_variance + 2 * covariance + variance).sqrt()
        separation[chosen] = -torch.inf
        best = int(separation.argmax())
        total_gain += float(gain[best])
        total_variance += float(2 * covariance[best] + variance[best])
        covariance += (same @ same[best] + other @ other[best]) / first.shape[0]
        chosen.append(best)
    print(
        f"separation {total_gain / total_variance**0.5:.3f}, mean gain {total_gain / TESTS:.3f} bits per test"
    )
    return chosen


def write_pattern(tests: np.ndarray, path: Path) -> None:
    """(256, 4) whole numbers as a Python module."""
    rows = [
        ", ".join(str(tuple(int(v) for v in test)) for test in tests[k : k + 4]) for k in range(0, TESTS, 4)
    ]
    lines = "\n".join(f"    {row}," for row in rows)
    path.write_text(
        '"""The tests of the descriptor: x1, y1, x2, y2 of each in pixels of the level, within radius 14.5.\n\n'
        'Written by experiments/benchmarks/learn_pattern.py.\n"""\n\n'
        f"PATTERN: tuple[tuple[int, int, int, int], ...] = (\n{lines}\n)  # fmt: skip\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    with torch.no_grad():
        first, second = matching_samples(arguments.data, rng)
        print(f"{len(first)} pairs of patches")
        tests = random_tests(rng)
        chosen = greedy_search(first, second, torch.from_numpy(tests))
    points = np.array(grid_points())
    ends = points[tests[chosen]].reshape(TESTS, 4)
    write_pattern(ends, Path(brief.__file__).with_name("pattern.py"))


if __name__ == "__main__":
    main()
