"""A recording of a camera with a rolling shutter, as a graph with true poses."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, transform
from torchslam.optim.observation_graph import ObservationGraph

FRAME_RATE = 30.0
CAMERA = Camera.radial_tangential(400.0, 400.0, 319.5, 239.5, -0.1, 0.02, 0.0, 0.0, size=(640, 480))
NOISE_PX = 0.5


def path(times: Tensor, seed: int) -> Tensor:
    """T_cw (..., 4, 4) of a hand-held camera: it turns by up to one degree a frame and goes to and fro."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([0.2, 0.2, 0.2, 0.08, 0.08, 0.05], dtype=torch.float64)
    rates, phases, weights = torch.rand(3, 3, 6, generator=generator, dtype=torch.float64)
    waves = torch.sin(times[..., None, None] * (0.05 + 0.25 * rates) + 2 * math.pi * phases)
    return se3_exp((size * (0.5 + weights) * waves).sum(-2))


def recording(
    readout: float, seed: int = 0, noise: float = NOISE_PX, frames: int = 40, points: int = 120
) -> ObservationGraph:
    """Keypoints of a rolling shutter, in a graph with the poses at the middles of the exposures."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    points_w = torch.stack((2.0 * normal(points), 1.5 * normal(points), 4 + normal(points).clamp(-2, 2)), -1)
    frame, point = torch.ones(frames, points).nonzero().unbind(-1)
    times = frame.double()
    for _ in range(6):  # the row decides about the time, and the time about the row
        pixels, valid = CAMERA.project(transform(path(times, seed), points_w[point][:, None]))
        times = frame + readout * ((pixels[:, 0, 1] + 0.5) / CAMERA.height - 0.5)
    seen = (valid & CAMERA.in_image(pixels))[:, 0]
    moments = torch.arange(frames, dtype=torch.float64)
    return ObservationGraph(
        moments / FRAME_RATE,
        path(moments, seed),
        points_w,
        frame[seen],
        point[seen],
        pixels[seen, 0] + noise * normal(int(seen.sum()), 2),
        torch.full((int(seen.sum()),), NOISE_PX**-2, dtype=torch.float64),
        CAMERA,
        moments % 4 == 0,
    )
