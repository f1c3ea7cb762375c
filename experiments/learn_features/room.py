"""How much there is to gain: pose errors of pairs, by the noise of their keypoints and beside another front end."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from experiments.common import table
from experiments.learn_features.pairs import Pair, matched, motion_of
from experiments.learn_features.tracks import MAX_ERROR
from torchslam.geometry import correct_matches, essential_from_pose
from torchslam.learning.losses import motion_difference

NOISES_PX = (0.0, 0.25, 0.5, 1.0)


@torch.no_grad()
def room(front_end: nn.Module, other: nn.Module, pairs: list[Pair]) -> str:
    """A table of median errors of rotation and direction.

    First of a front end and of another; then of what their errors have in common and of what not: half the sum of the
    errors of both, as vectors, and half the difference, which for independent errors are equally long. Then of the
    first front end's matches if all but the wrong ones were where the true motion has them, but for Gaussian noise.
    """
    generator = torch.Generator().manual_seed(0)
    errors: dict[str, list[Tensor]] = {}
    for pair in pairs:
        features, features_other = (module(pair.images).to("cpu") for module in (front_end, other))
        pixels_1, pixels_2 = matched(features)
        first = error_of(pixels_1, pixels_2, pair)
        second = error_of(*matched(features_other), pair)
        found = {
            "XFeat": first,
            "ORB": second,
            "half the sum of both errors": (first + second) / 2,
            "half their difference": (first - second) / 2,
        }
        exact_1, exact_2, right = exact_matches(pixels_1, pixels_2, pair)
        for sigma in NOISES_PX:
            noise_1, noise_2 = sigma * torch.randn(
                2, *exact_1.shape, generator=generator, dtype=exact_1.dtype
            )
            moved_1 = torch.where(right[:, None], exact_1 + noise_1, pixels_1)
            moved_2 = torch.where(right[:, None], exact_2 + noise_2, pixels_2)
            found[f"XFeat's matches, noise of {sigma:g} px"] = error_of(moved_1, moved_2, pair)
        for label, error in found.items():
            errors.setdefault(label, []).append(error.norm(dim=-1))
    rows = []
    for label, each in errors.items():
        rotation, direction = torch.stack(each).nanmedian(0).values.tolist()
        rows.append([label, f"{1e3 * rotation:.2f}", f"{math.degrees(direction):.2f}"])
    return table([f"{len(pairs)} pairs to learn from", "rotation error (mrad)", "direction error (°)"], rows)


def error_of(pixels_1: Tensor, pixels_2: Tensor, pair: Pair) -> Tensor:
    """(2, 3) errors of rotation and direction as `motion_difference` has them; NaN where no motion fits."""
    motion = motion_of(pixels_1, pixels_2, pair.camera)
    return motion_difference(motion.T_21[0], pair.T_21) + (0.0 if motion.success[0] else torch.nan)


def exact_matches(pixels_1: Tensor, pixels_2: Tensor, pair: Pair) -> tuple[Tensor, Tensor, Tensor]:
    """The pixels (M, 2) nearest to matches that agree with the true motion, and which had to move little (M,)."""
    camera = pair.camera
    E = essential_from_pose(pair.T_21[:3, :3], pair.T_21[:3, 3])
    corrected = correct_matches(E, camera.normalize(pixels_1), camera.normalize(pixels_2))
    exact_1, exact_2 = (camera.project(torch.cat([x, torch.ones_like(x[:, :1])], -1))[0] for x in corrected)
    moved = torch.cat([exact_1 - pixels_1, exact_2 - pixels_2], -1).norm(dim=-1)
    return exact_1, exact_2, moved < MAX_ERROR
