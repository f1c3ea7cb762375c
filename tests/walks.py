"""Sequences of poses without pictures, for simulated features."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera, rigid, se3_inverse, so3_exp
from torchslam.types import Trajectory


class Walk(Sequence):
    """A camera that follows given poses and sees a blank image."""

    def __init__(self, T_wc: Tensor) -> None:
        camera = Camera.pinhole(400.0, 400.0, 159.5, 119.5, size=(320, 240))
        timestamps = torch.arange(len(T_wc), dtype=torch.float64) / 10
        super().__init__("walk", "poses", camera, timestamps, Trajectory(timestamps, T_wc))

    def image(self, index: int) -> Tensor:
        return torch.zeros(1, 1, 240, 320)

    def image_name(self, index: int) -> str:
        return f"pose {index}"


def arc(frames: int, length: float = 3.0) -> Tensor:
    """(F, 4, 4) T_wc of a walk sideways along an arc, turning with it."""
    s = torch.linspace(0, 1, frames, dtype=torch.float64)
    zero = torch.zeros_like(s)
    centers = torch.stack([length * s, 0.2 * torch.sin(6 * s), 0.4 * length * s * (1 - s)], -1)
    return rigid(so3_exp(torch.stack([0.05 * torch.sin(4 * s), -0.4 * s, zero], -1)), centers)


def walk_with_jump(first: int = 16, later: int = 42) -> Tensor:
    """(F, 4, 4) T_wc of a camera that walks to the right, jumps far away, and walks back to its start."""
    x = torch.cat([torch.linspace(0, 1.0, first), torch.linspace(3.6, 0.5, later)]).double()
    turns = torch.stack([torch.zeros_like(x), 0.05 * torch.sin(3 * x), torch.zeros_like(x)], -1)
    return rigid(so3_exp(turns), torch.stack([x, 0.1 * torch.sin(4 * x), 0.1 * torch.cos(5 * x)], -1))


def still(frames: int) -> Tensor:
    return torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)


def turn(frames: int, angle: float = math.pi / 6) -> Tensor:
    """A camera that turns about its own y axis."""
    s = torch.linspace(0, angle, frames, dtype=torch.float64)
    zero = torch.zeros_like(s)
    return rigid(so3_exp(torch.stack([zero, s, zero], -1)), zero[:, None].expand(-1, 3))


def T_cw(walk: Walk) -> Tensor:
    assert walk.groundtruth is not None
    return se3_inverse(walk.groundtruth.T_wc)
