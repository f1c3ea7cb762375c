"""The focal length by pairs of images whose pixels are not square."""

from __future__ import annotations

import pytest
import torch

from torchslam.calibration.from_pairs import _solve
from torchslam.data.transforms import scale_camera
from torchslam.geometry import Camera, rigid, so3_exp


@pytest.mark.parametrize("size", [(640, 480), (480, 480), (640, 360)])
def test_the_given_ratio_of_the_focal_lengths_is_kept(
    size: tuple[int, int], generator: torch.Generator
) -> None:
    true = scale_camera(Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480)), size)
    points_w = torch.rand(200, 3, generator=generator, dtype=torch.float64) * 4 + torch.tensor([-2.0, -2, 3])
    pairs = []
    for _ in range(8):
        turn, move = torch.randn(2, 3, generator=generator, dtype=torch.float64) * torch.tensor(
            [[0.1], [0.5]]
        )
        T_21 = rigid(so3_exp(turn), move)
        pixels_1, pixels_2 = (
            true.project(points)[0] + 0.1 * torch.randn(200, 2, generator=generator, dtype=torch.float64)
            for points in (points_w, points_w @ T_21[:3, :3].mT + T_21[:3, 3])
        )
        cross = torch.linalg.cross(move.expand(3, 3), T_21[:3, :3].mT).mT
        inverse = torch.linalg.inv(true.K)
        pairs.append((inverse.mT @ cross @ inverse, pixels_1.float(), pixels_2.float()))
    guess = true.with_params(torch.cat([1.3 * true.params[:2], true.params[2:]]))
    found = _solve(pairs, guess, 1.0)
    assert bool(found.success)
    assert float(found.focal) == pytest.approx(float(true.fx), rel=0.01)
