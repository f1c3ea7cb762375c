"""The pose next to where the camera is expected, without RANSAC: where most matches agree with it, no other can be."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry import Undistorted
from torchslam.optim.pose.frame_pose import FrameProblem

MAJORITY = 0.75
"""Share of the matches that must agree: any other pose with as many has at least half of all in common with it."""


def nearby_pose(
    expected_T_cw: Tensor, points_w: Tensor, undistorted: Undistorted, threshold: float
) -> Tensor | None:
    """The pose (4, 4) that matches lead to from an expected one; None where too few of them agree with it.

    By all of them, of which those that are far off count little, then by those that agree.

    points_w: (N, 3), and where they are seen; threshold: of a match that agrees, pixels
    """
    problem = FrameProblem(points_w, undistorted.xy, undistorted.slope / threshold)
    everyone = torch.ones_like(points_w[:, 0])
    first = problem.minimize(problem.see(expected_T_cw), everyone, "cauchy")
    found = problem.minimize(first.sighting, everyone * (first.sighting.squared < 1), "huber")
    agreed = int((found.sighting.squared < 1).sum())
    return found.T_cw if found.success and agreed >= MAJORITY * len(points_w) else None
