"""How many matches of lookalikes agree with one motion of the camera, by the truth of the pair?"""

from __future__ import annotations

import torch
from torch import Tensor

from experiments.benchmarks.problems import match_pixels
from experiments.places.images import lookalike_truth
from torchslam.geometry import Camera, estimate_relative_pose
from torchslam.types import Features

SIZE = (512, 384)
FOCAL = 0.9 * SIZE[0]  # the camera is unknown: a guess
THRESHOLD = 2.0  # pixels, wide for a guessed camera
MIN_MATCHES = 10  # fewer are not verified by RANSAC
MAX_SAMPLES = 1000


def inliers_of_pairs(features: Features) -> Tensor:
    """(84, 84) int64: inliers of the relative pose of each pair that is a question, 0 where there is no pose."""
    _, asked = lookalike_truth()
    inliers = torch.zeros(asked.shape, dtype=torch.int64)
    center = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    params = torch.tensor((FOCAL, FOCAL, *center), dtype=torch.float64)
    camera = Camera("pinhole", params, SIZE)
    for later, earlier in asked.nonzero().tolist():
        first, second = features[later : later + 1], features[earlier : earlier + 1]
        pixels_1, pixels_2 = match_pixels(first, second)
        if len(pixels_1) < MIN_MATCHES:
            continue
        pose = estimate_relative_pose(
            pixels_1[None], pixels_2[None], camera, camera, THRESHOLD, max_samples=MAX_SAMPLES
        )
        inliers[later, earlier] = int(pose.inliers.sum())
    return inliers
