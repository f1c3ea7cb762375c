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

WALK = (  # over the storey: x, z and heading in quarter turns to the right from z, of each end of a step or a turn
    (-4.0, -4.1, 1),
    (5.1, -4.1, 1),
    (5.1, -4.1, 0),
    (5.1, 0.0, 0),
    (5.1, 0.0, -1),  # into the room ...
    (2.2, 0.0, -1),
    (2.2, 0.0, -3),  # ... around, and out again
    (5.1, 0.0, -3),
    (5.1, 0.0, -4),
    (5.1, 4.1, -4),
    (5.1, 4.1, -5),
    (-5.1, 4.1, -5),
    (-5.1, 4.1, -6),
    (-5.1, -4.1, -6),
    (-5.1, -4.1, -7),
    (-4.0, -4.1, -7),
)
QUARTER_TIME = 1.4
"""A quarter turn takes as long as a walk of so many meters."""
EASING = 0.6
"""Meters of the walk before and after over which speeds even out."""
ARM = 0.3
"""Meters: so far in front of the body is the camera held, so that it moves where the body only turns."""


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
    return _poses(x, y, z, yaw, pitch, roll)


def standstill(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """No motion at all."""
    return _poses(*[torch.zeros_like(phase)] * 6)


def rotation(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """A camera that turns about its own center and back."""
    zero = torch.zeros_like(phase)
    return _poses(
        zero, zero, zero, 0.7 * torch.sin(phase), 0.2 * torch.sin(2 * phase), 0.1 * torch.sin(phase)
    )


def sideways(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """A slow walk along the wall and back, turned toward it from changing angles."""
    return _poses(
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
    return _poses(
        x + 0.012 * torch.sin(29.3 * phase),
        0.015 * torch.sin(47.3 * phase) + 0.05 * torch.sin(3.3 * phase + 0.5),
        z + 0.012 * torch.sin(23.9 * phase + 1.0),
        phase - 0.25 * torch.sin(4 * phase) - OUTWARD + 0.015 * torch.sin(36.4 * phase),
        -0.03 + 0.012 * torch.sin(31.7 * phase + 0.4),
        0.01 * torch.sin(41.2 * phase),
    )


def round_the_storey(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """Around the corridor of the storey and into its room, one round a phase of 2 pi; the body turns in place.

    The camera is held at arm's length and looks ahead, it sways and glances to the sides.
    """
    x, z, yaw = _walked(phase)
    yaw = yaw + 0.15 * torch.sin(17.3 * phase) + 0.015 * torch.sin(61.7 * phase)
    return _poses(
        x + ARM * torch.sin(yaw) + 0.012 * torch.sin(49.1 * phase),
        -0.1 + 0.015 * torch.sin(83.7 * phase) + 0.05 * torch.sin(5.3 * phase + 0.5),
        z + ARM * torch.cos(yaw) + 0.012 * torch.sin(43.9 * phase + 1.0),
        yaw,
        -0.02 + 0.012 * torch.sin(57.7 * phase + 0.4),
        0.01 * torch.sin(71.2 * phase),
    )


def _walked(phase: Float[Tensor, " N"]) -> Float[Tensor, "3 N"]:
    """x, z and yaw of the body on `WALK`, eased by a Hann window over the time."""
    ends = torch.tensor(WALK, dtype=torch.float64, device="cpu")
    steps = ends.diff(dim=0)
    durations = steps[:, :2].norm(dim=-1) + QUARTER_TIME * steps[:, 2].abs()
    starts = torch.cat((durations.new_zeros(1), durations.cumsum(0)))
    window = torch.linspace(-1, 1, 25, dtype=torch.float64, device="cpu")[1:-1]
    weights = torch.cos(0.5 * math.pi * window) ** 2
    time = (phase[:, None] * (starts[-1] / (2 * math.pi)) + EASING * window) % starts[-1]
    row = (torch.searchsorted(starts, time, right=True) - 1).clamp(max=len(steps) - 1)
    share = (time - starts[row]) / durations[row]
    at = ends[row] + share[..., None] * steps[row]
    # A round ends eight quarter turns from where it began: in a window over its end the heading goes on from there.
    jump = torch.round((at[..., 2] - at[:, len(window) // 2, None, 2]) / 8) * 8
    at = torch.stack((at[..., 0], at[..., 1], 0.5 * math.pi * (at[..., 2] - jump)))
    return (at * weights).sum(-1) / weights.sum()


def phases(frames: int, frames_per_round: int) -> Float[Tensor, " N"]:
    """Return the phase of each frame, from 0."""
    return torch.arange(frames, dtype=torch.float64, device="cpu") * (2 * math.pi / frames_per_round)


def _poses(x: Tensor, y: Tensor, z: Tensor, yaw: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """T_wc from position, meters, and angles, radians: about y, then x, then z of the camera."""
    zero = torch.zeros_like(x)
    R_wc = (
        so3_exp(torch.stack((zero, yaw, zero), dim=-1))
        @ so3_exp(torch.stack((pitch, zero, zero), dim=-1))
        @ so3_exp(torch.stack((zero, zero, roll), dim=-1))
    )
    return rigid(R_wc, torch.stack((x, y, z), dim=-1))
