"""The reader of problems in BAL's format: its model of a camera, and that a problem is written and read back."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from experiments.benchmarks.bal import ceres, cost, disturbed, ours, read_bal, write_bal
from torchslam.geometry import Camera, se3_exp, so3_exp, transform
from torchslam.optim import BundleProblem

CAMERA = [0.1, -0.2, 0.3, 0.5, -0.4, -6.0, 500.0, -0.1, 0.02]
POINT = [0.3, -0.2, 0.5]


def test_a_pixel_is_where_the_format_says(tmp_path: Path) -> None:
    """https://grail.cs.washington.edu/projects/bal: P = R X + t, p = -P / P.z, p' = f (1 + k1 p^2 + k2 p^4) p."""
    camera, X = torch.tensor(CAMERA, dtype=torch.float64), torch.tensor(POINT, dtype=torch.float64)
    P = so3_exp(camera[:3]) @ X + camera[3:6]
    p = -P[:2] / P[2]
    squared = p @ p
    pixel = camera[6] * (1 + camera[7] * squared + camera[8] * squared**2) * p
    numbers = [*CAMERA, *POINT]
    text = f"1 1 1\n0 0 {float(pixel[0])!r} {float(pixel[1])!r}\n" + "\n".join(map(repr, numbers))
    (tmp_path / "problem.txt").write_text(text)
    problem = read_bal(tmp_path / "problem.txt")
    points_c = transform(problem.T_cw, problem.points_w)
    assert float(points_c[0, 0, 2]) > 0
    torch.testing.assert_close(
        problem.camera.project(points_c)[0][0, 0], problem.pixels[0], atol=1e-9, rtol=0
    )
    assert cost(problem, problem.T_cw, problem.points_w, problem.camera.params) < 1e-15
    write_bal(tmp_path / "again.txt", problem)
    again = read_bal(tmp_path / "again.txt")
    for name in ("T_cw", "points_w", "pixels", "frame_index"):
        torch.testing.assert_close(getattr(again, name), getattr(problem, name))
    torch.testing.assert_close(again.camera.params, problem.camera.params)


def test_the_minimum_with_all_9_numbers_free_is_that_of_ceres() -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    T_cw = se3_exp(0.2 * normal(6, 6))
    points_w = normal(80, 3) + torch.tensor([0.0, 0.0, 5.0]).double()
    params = torch.tensor([[500.0, 500.0, 0, 0, -0.05, 0.01, 0, 0, 0]], dtype=torch.float64).repeat(6, 1)
    camera = Camera("radial_tangential", params, (640, 480))
    pixels = camera.project(transform(T_cw, points_w))[0] + 0.5 * normal(6, 80, 2)
    frames, points = (normal(6, 80) < 1).nonzero().unbind(-1)
    index = torch.arange(6)
    exact = BundleProblem(T_cw, points_w, frames, points, pixels[frames, points], camera, camera_index=index)
    problem = disturbed(exact)
    row, expected = ours(problem, 50, gradient=False, free=True), ceres(problem, 100, free=True)
    assert float(row[2]) == pytest.approx(float(expected[2]), abs=0.11)
    assert float(row[2]) < 1.0 * len(frames)
