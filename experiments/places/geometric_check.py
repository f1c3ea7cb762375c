"""How many matches of lookalikes agree with one motion of the camera, by the truth of the pair?"""

from __future__ import annotations

import torch
from torch import Tensor

from experiments.places.images import lookalike_truth
from torchslam.features import match
from torchslam.geometry import Camera, estimate_relative_pose
from torchslam.types import Features

SIZE = (512, 384)
FOCAL = 0.9 * SIZE[0]  # the camera is unknown: a guess
THRESHOLD = 2.0  # pixels, wide for a guessed camera
MIN_MATCHES = 8  # below, RANSAC is not asked


def inliers_of_pairs(
    features: Features, scores: Tensor | None = None, best: int = 0
) -> tuple[Tensor, Tensor]:
    """Inliers of the relative pose of all pairs that are a question, or of the `best` per image by scores (84, 84).

    Returns inliers (P,) int64 and whether the pair is true (P,); a pose that was not found has none.
    """
    same, asked = lookalike_truth()
    if scores is not None:
        candidates = scores.masked_fill(~asked, -1.0).topk(best, dim=1).indices
        asked = asked & torch.zeros_like(asked).scatter(1, candidates, True)
    camera = Camera.pinhole(FOCAL, FOCAL, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2, size=SIZE)
    camera = Camera(camera.model, camera.params.double(), SIZE)
    counts = []
    for later, earlier in asked.nonzero().tolist():
        first, second = features[later : later + 1], features[earlier : earlier + 1]
        matches = match(first, second)
        rows = matches.mask[0]
        if int(rows.sum()) < MIN_MATCHES:
            counts.append(0)
            continue
        pixels_1 = first.keypoints[:, matches.indices_1[0, rows]].double()
        pixels_2 = second.keypoints[:, matches.indices_2[0, rows]].double()
        pose = estimate_relative_pose(pixels_1, pixels_2, camera, camera, THRESHOLD)
        counts.append(int(pose.inliers.sum()))
    return torch.tensor(counts), same[asked]
