"""Two views at a time: how well matched keypoints tell the motion between them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchslam import estimate_relative_pose, match
from torchslam.data.sequence import Sequence
from torchslam.geometry import se3_inverse, so3_log

APART_S = 0.3
THRESHOLD_PX = 1.5


@dataclass(frozen=True)
class PairErrors:
    """Of P pairs: rotations and directions of the translation (P,), radians; inliers (P,); NaN, 0 where none fits."""

    rotation: Tensor
    direction: Tensor
    inliers: Tensor


def frames_apart(sequence: Sequence) -> int:
    """Frames that make up APART_S."""
    return max(1, round(APART_S * sequence.frame_rate))


@torch.no_grad()
def pair_errors(
    front_end: nn.Module, sequence: Sequence, starts: list[int], device: torch.device
) -> PairErrors:
    """Relative poses of the pairs of frames (start, start + APART_S) by five-point RANSAC, against the true ones."""
    apart = frames_apart(sequence)
    camera = sequence.camera.to(torch.float64)
    rows = []
    for start in starts:
        first, second = sequence[start], sequence[start + apart]
        if first.T_cw_groundtruth is None or second.T_cw_groundtruth is None:
            raise ValueError(f"{sequence.name}: frame {start} or {start + apart} has no true pose")
        features = front_end(torch.cat([first.image, second.image]).to(device)).to("cpu")
        one, two = features[:1], features[1:]
        matches = match(one, two, max_distance=64 if one.descriptors.dtype == torch.uint8 else 0.25)
        pixels_1 = one.keypoints[0][matches.indices_1[0]][None].double()
        pixels_2 = two.keypoints[0][matches.indices_2[0]][None].double()
        found = estimate_relative_pose(pixels_1, pixels_2, camera, camera, THRESHOLD_PX, matches.mask)
        T_21 = second.T_cw_groundtruth @ se3_inverse(first.T_cw_groundtruth)
        rotation = so3_log(found.T_21[0, :3, :3] @ T_21[:3, :3].mT).norm()
        direction = torch.acos(F.cosine_similarity(found.T_21[0, :3, 3], T_21[:3, 3], dim=0).clamp(-1, 1))
        failed = torch.where(found.success[0], 0.0, torch.nan)
        rows.append(torch.stack([rotation + failed, direction + failed, found.inliers[0].sum().double()]))
    return PairErrors(*torch.stack(rows).unbind(-1))
