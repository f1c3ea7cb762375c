"""Quality and speed of features and matching compared with OpenCV, in one run on one thread.

    python -m experiments.benchmarks.features [--data FOLDER] [--output FILE] [--pairs 8]

FOLDER holds the sequences. Both extractors give 1000 keypoints, and the same matcher matches them; OpenCV's keypoints
are those of `OpenCVORB`, that is with the half pixel put right that cv2.ORB is off on its higher levels. Times are CPU
time of the thread, so that other work on the machine counts as little as possible, interleaved with the peer.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import poselib
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from experiments.benchmarks.problems import match_pixels
from experiments.common import DATA_DIR, milliseconds, parser_of, publish_page, table
from torchslam.features import ORB, OpenCVORB, match, match_by_projection
from torchslam.types import Features

HERE = Path(__file__).parent
SEQUENCES = ("redkitchen", "kitti07", "shelf_bin")
GAPS = (1, 5, 10, 20)
NEAR = 2.5  # pixels: a keypoint is repeated if one is found that near to where it should be
RIGHT = 3.0  # pixels: a match is right
MARGIN = 22.0  # pixels from the border of the other image within which nothing is expected


def to_tensor(image: NDArray) -> Tensor:
    return torch.from_numpy(image).float()[None, None] / 255


def read(data: Path, sequence: str) -> list[Path]:
    return sorted((data / sequence / "rgb").iterdir())


def gray(path: Path) -> NDArray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"{path}: cannot be read")
    return image


def epipolar(
    data: Path, sequence: str, gap: int, pairs: int, extract: nn.Module, **options: Any
) -> tuple[float, float]:
    """Mean number of matches that one essential matrix explains to 1 px, and their mean share of all matches."""
    paths = read(data, sequence)
    fx, fy, cx, cy = (float(v) for v in (data / sequence / "calibration.txt").read_text().split()[:4])
    counts, shares = [], []
    for start in np.linspace(0, len(paths) - 1 - max(GAPS), pairs).astype(int):
        images = [gray(paths[start]), gray(paths[start + gap])]
        height, width = images[0].shape
        camera = {"model": "PINHOLE", "width": width, "height": height, "params": [fx, fy, cx, cy]}
        first, second = (extract(to_tensor(image)) for image in images)
        pixels_1, pixels_2 = (side.numpy() for side in match_pixels(first, second, **options))
        ransac = {"max_epipolar_error": 1.0, "min_iterations": 200, "max_iterations": 1000, "seed": 0}
        _, found = poselib.estimate_relative_pose(pixels_1, pixels_2, camera, camera, ransac, {})
        counts.append(sum(found["inliers"]))
        shares.append(counts[-1] / max(1, len(pixels_1)))
    return float(np.mean(counts)), float(np.mean(shares))


def changes(height: int, width: int) -> dict[str, tuple[NDArray, float, float, float]]:
    """Known changes of an image: a homography, noise in gray values, gain and offset."""
    center = np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1.0]])

    def turned(degrees: float, scale: float) -> NDArray:
        c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
        return center @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.linalg.inv(center)

    tilt = np.eye(3)
    tilt[2, :2] = 2.5e-4, -2e-4
    return {
        "rotation 15°": (turned(15, 1), 0, 1, 0),
        "rotation 30°": (turned(30, 1), 0, 1, 0),
        "rotation 77°": (turned(77, 1), 0, 1, 0),
        "scale 0.8": (turned(0, 0.8), 0, 1, 0),
        "scale 0.6": (turned(5, 0.6), 0, 1, 0),
        "scale 1.3": (turned(0, 1.3), 0, 1, 0),
        "noise 8": (np.eye(3), 8, 1, 0),
        "darker": (turned(3, 1), 2, 0.6, 0),
        "brighter": (turned(3, 1), 2, 1.2, 15),
        "tilted": (center @ tilt @ np.linalg.inv(center), 2, 1, 0),
    }


def changed(image: NDArray, change: tuple[NDArray, float, float, float]) -> NDArray:
    homography, noise, gain, offset = change
    shrink = np.sqrt(np.linalg.det(homography[:2, :2]))
    if shrink < 0.95:
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / shrink**2 - 1))
    out = cv2.warpPerspective(image, homography, image.shape[::-1]).astype(np.float64)
    out = out * gain + offset + np.random.default_rng(0).normal(0, 1, out.shape) * noise
    return np.clip(out, 0, 255).astype(np.uint8)


def mapped(homography: NDArray, pixels: NDArray) -> NDArray:
    moved = np.c_[pixels, np.ones(len(pixels))] @ homography.T
    return moved[:, :2] / moved[:, 2:]


def known_change(
    image: NDArray, change: tuple[NDArray, float, float, float], extract: nn.Module
) -> list[float]:
    """Repeatability, share and number of right matches, and the median error of the right ones in pixels."""
    homography, size = change[0], np.array(image.shape[::-1])
    first, second = extract(to_tensor(image)), extract(to_tensor(changed(image, change)))

    def shared(features: Features, towards: NDArray) -> NDArray:
        """Where the keypoints that the other image must see lie in it."""
        moved = mapped(towards, features.keypoints[0][features.mask[0]].double().numpy())
        return moved[((moved > MARGIN) & (moved < size - MARGIN)).all(1)]

    seen_1 = shared(first, homography)
    seen_2 = mapped(homography, shared(second, np.linalg.inv(homography)))
    nearest = np.linalg.norm(seen_1[:, None] - seen_2[None], axis=-1).min(1)
    matched = match_pixels(first, second, ratio=None, max_distance=None)
    pixels_1, pixels_2 = (side.numpy() for side in matched)
    errors = np.linalg.norm(mapped(homography, pixels_1) - pixels_2, axis=1)
    right = errors < RIGHT
    return [float(v) for v in ((nearest < NEAR).mean(), right.mean(), right.sum(), np.median(errors[right]))]


def random_descriptors(count: int, seed: int) -> Features:
    generator = torch.Generator().manual_seed(seed)
    described = torch.randint(0, 256, (1, count, 32), dtype=torch.uint8, generator=generator)
    keypoints = torch.rand(1, count, 2, generator=generator) * torch.tensor([640.0, 480.0])
    ones = torch.ones(1, count)
    return Features(keypoints, ones, ones, ones, described, ones.bool())


def speed_tables(image: NDArray) -> list[str]:
    peer, tensor = cv2.ORB.create(1000), to_tensor(image)
    ours, theirs = milliseconds(
        partial(ORB(1000), tensor), lambda: peer.detectAndCompute(image, None), repeats=30
    )
    row = ["torchslam", f"{ours:.1f}", f"{theirs:.1f}", f"{ours / theirs:.1f}"]
    tables = [table("ORB, 1000 keypoints, 640x480 | ms | cv2.ORB | ratio", [row])]
    rows = []
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    for count in (1000, 2000):
        a, b = random_descriptors(count, 0), random_descriptors(count, 1)
        arrays = a.descriptors[0].numpy(), b.descriptors[0].numpy()
        ours, theirs = milliseconds(
            partial(match, a, b, ratio=None, max_distance=None), partial(matcher.match, *arrays), repeats=30
        )
        rows.append([f"{count} x {count}", f"{ours:.2f}", f"{theirs:.2f}", f"{ours / theirs:.2f}"])
    tables.append(table("Hamming, mutual | ms | cv2.BFMatcher | ratio", rows))
    rows = []
    for points, keypoints in ((1000, 1000), (2000, 1000), (3000, 2000)):
        a, b = random_descriptors(points, 0), random_descriptors(keypoints, 1)
        searches = [
            partial(match_by_projection, a.descriptors, a.keypoints, radius, b) for radius in (15.0, 50.0)
        ]
        times = milliseconds(*searches, repeats=30)
        rows.append([f"{points} x {keypoints}", *(f"{spent:.1f} ms" for spent in times)])
    header = "matching by projection, points x keypoints | radius 15 px | radius 50 px"
    return [*tables, table(header, rows)]


def quality_tables(data: Path, pairs: int) -> list[str]:
    extractors: dict[str, nn.Module] = {"ours": ORB(1000), "cv2": OpenCVORB(1000)}
    tables = []
    for title, options in (
        ("mutual nearest neighbors", {"ratio": None, "max_distance": None}),
        ("mutual and ratio 0.8", {"ratio": 0.8, "max_distance": None}),
    ):
        rows = []
        for sequence in SEQUENCES:
            cells = [sequence]
            for gap in GAPS:
                results = {
                    n: epipolar(data, sequence, gap, pairs, e, **options) for n, e in extractors.items()
                }
                (ours, share), (theirs, their_share) = results["ours"], results["cv2"]
                cells.append(f"{ours:.0f} / {theirs:.0f}, {share:.3f} / {their_share:.3f}")
            rows.append(cells)
        tables.append(table([f"{title}, frames apart", *map(str, GAPS)], rows))
    images = [
        gray(path)
        for name in SEQUENCES
        for path in (lambda p: p[:: max(1, len(p) // 3)][:3])(read(data, name))
    ]
    rows = []
    for name in changes(2, 2):
        ours, theirs = (
            np.mean([known_change(image, changes(*image.shape)[name], e) for image in images], axis=0)
            for e in extractors.values()
        )
        formats = ("{:.3f}", "{:.3f}", "{:.0f}", "{:.2f}")
        cells = [f"{f.format(a)} / {f.format(b)}" for f, a, b in zip(formats, ours, theirs, strict=True)]
        rows.append([name, *cells])
    return [*tables, table("known change | repeatability | precision | right matches | error, px", rows)]


def main() -> None:
    parser = parser_of(__doc__, HERE / "features.md")
    parser.add_argument("--data", type=Path, default=DATA_DIR)
    parser.add_argument("--pairs", type=int, default=8, help="of images, per sequence and distance")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    with torch.no_grad():
        image = cv2.resize(gray(read(arguments.data, "redkitchen")[0]), (640, 480))
        parts = [
            "One thread, CPU time, medians.\n",
            *speed_tables(image),
            "Quality, torchslam / OpenCV: matches that one essential matrix explains to 1 px, and their share.\n",
            *quality_tables(arguments.data, arguments.pairs),
        ]
    text = "\n".join(parts)
    publish_page("Features and matching compared with OpenCV", text, arguments)


if __name__ == "__main__":
    main()
