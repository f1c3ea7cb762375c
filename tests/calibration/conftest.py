"""Graphs of keyframes with a known camera."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, transform
from torchslam.optim.observation_graph import ObservationGraph


@pytest.fixture
def truth() -> Camera:
    """A wide-angle lens."""
    return Camera.radial_tangential(400.0, 404.0, 320.0, 240.0, -0.28, 0.07, 1e-3, -1e-3, size=(640, 480))


@pytest.fixture
def simulated(truth: Camera) -> Callable[..., ObservationGraph]:
    def make(
        camera: Camera = truth,
        noise: float = 0.0,
        frames: int = 12,
        points: int = 80,
        seed: int = 0,
        twists: Tensor | None = None,
        depth: float = 1.0,
    ) -> ObservationGraph:
        """Keyframes around a cloud of points, seen by the camera, and started at the truth; of depth 0 it is a wall."""
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        if twists is None:
            twists = 0.1 * normal(frames, 6)
            twists[:, 0] += torch.linspace(-1.5, 1.5, frames, dtype=torch.float64)
            twists[:, 4] += torch.linspace(0.3, -0.3, frames, dtype=torch.float64)
        T_cw = se3_exp(twists)
        points_w = torch.stack(
            (1.5 * normal(points), normal(points), 5 + depth * normal(points).clamp(-2, 2)), -1
        )
        frame_index, point_index = torch.ones(frames, points).nonzero().unbind(-1)
        pixels, valid = camera.project(transform(T_cw[frame_index], points_w[point_index][:, None]))
        seen = (valid & camera.in_image(pixels))[:, 0]
        return ObservationGraph(
            torch.arange(frames, dtype=torch.float64),
            T_cw,
            points_w,
            frame_index[seen],
            point_index[seen],
            pixels[seen, 0] + noise * normal(int(seen.sum()), 2),
            torch.ones(int(seen.sum()), dtype=torch.float64),
            camera,
            torch.ones(frames, dtype=torch.bool),
        )

    return make
