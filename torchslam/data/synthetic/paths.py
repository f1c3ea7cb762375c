"""Smooth camera paths through the synthetic scenes: float64 T_wc from the phase of each frame."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.lie import rigid, so3_exp

RADIUS = 2.87
"""Meters: the length of the walk around the core by 2 pi."""
OUTWARD = 0.5
"""Radians from the heading to where the camera looks."""
HARMONICS = ((1, 0.98444), (-3, -0.04134), (5, -0.02481), (-7, -0.00111), (9, 0.00086))
"""Fourier series of the integral of exp(i (phase - sin(4 phase) / 4)): orders 1 - 4 n,
weights J_n(1 / 4) / (1 - 4 n)."""


def loop(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """A figure of eight through the middle of the room, one round a phase of 2 pi, held in a hand that sways.

    The sway's periods do not divide the round's, so that no two rounds are the same.
    """
    x = 1.1 * torch.sin(phase) + 0.02 * torch.sin(7.3 * phase)
    y = -0.1 + 0.12 * torch.sin(2.0 * phase + 0.5) + 0.015 * torch.sin(11.7 * phase)
    z = -0.5 - 0.55 * torch.sin(2.0 * phase) + 0.02 * torch.sin(5.9 * phase + 1.0)
    yaw = 0.45 * torch.sin(phase - 0.9) + 0.02 * torch.sin(9.1 * phase)
    pitch = 0.08 * torch.sin(2.0 * phase + 1.3) + 0.015 * torch.sin(8.3 * phase + 0.4)
    roll = 0.05 * torch.sin(phase + 0.7) + 0.01 * torch.sin(10.3 * phase)
    return poses(x, y, z, yaw, pitch, roll)


def standstill(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """No motion at all."""
    return poses(*[torch.zeros_like(phase)] * 6)


def rotation(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """A camera that turns about its own center and back."""
    zero = torch.zeros_like(phase)
    return poses(zero, zero, zero, 0.7 * torch.sin(phase), 0.2 * torch.sin(2 * phase), 0.1 * torch.sin(phase))


def sideways(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """A slow walk along the wall and back, turned toward it from changing angles."""
    return poses(
        1.2 * torch.sin(phase),
        0.2 * torch.sin(2 * phase),
        0.4 * torch.sin(phase + 0.5),
        -0.25 * torch.sin(phase),
        0.08 * torch.sin(2 * phase),
        0.05 * torch.sin(phase),
    )


def round_the_core(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """Around the core of the four rooms, one round a phase of 2 pi, from the door into the first room, to the right.

    The heading is phase - sin(4 phase) / 4: straight on at the four doors, twice the mean rate in the four corners,
    at constant speed. Its integral closes for the fourfold symmetry; `HARMONICS` is its Fourier series. The camera
    looks to the left of the heading, at the outer walls, and sways in the hand.
    """
    z = RADIUS * sum(weight * torch.sin(order * phase) for order, weight in HARMONICS)
    x = -RADIUS * sum(weight * torch.cos(order * phase) for order, weight in HARMONICS)
    return poses(
        x + 0.012 * torch.sin(29.3 * phase),
        0.015 * torch.sin(47.3 * phase) + 0.05 * torch.sin(3.3 * phase + 0.5),
        z + 0.012 * torch.sin(23.9 * phase + 1.0),
        phase - 0.25 * torch.sin(4 * phase) - OUTWARD + 0.015 * torch.sin(36.4 * phase),
        -0.03 + 0.012 * torch.sin(31.7 * phase + 0.4),
        0.01 * torch.sin(41.2 * phase),
    )


def phases(frames: int, frames_per_round: int) -> Float[Tensor, " N"]:
    """Return the phase of each frame, from 0."""
    return torch.arange(frames, dtype=torch.float64, device="cpu") * (2 * math.pi / frames_per_round)


def poses(x: Tensor, y: Tensor, z: Tensor, yaw: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """T_wc from position, meters, and angles, radians: about y, then x, then z of the camera."""
    zero = torch.zeros_like(x)
    R_wc = (
        so3_exp(torch.stack((zero, yaw, zero), dim=-1))
        @ so3_exp(torch.stack((pitch, zero, zero), dim=-1))
        @ so3_exp(torch.stack((zero, zero, roll), dim=-1))
    )
    return rigid(R_wc, torch.stack((x, y, z), dim=-1))
