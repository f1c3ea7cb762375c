"""`synthetic:storey`: a storey with a corridor and one room, for experiments; importing this module adds the scene.

python -m experiments.storey run synthetic:storey -o results/storey     # the command line of torchslam with it

The corridor of the storey is weak in texture; it leads all around a core with a furnished room. Seen from above, x to
the right and z up the page:

    +---------------------------+  z = 5
    |  corridor, 1.8 m wide     |
    |  +---------------------+  |
    |  |         |           |  |
    |  |         |   room       <- door
    |  |         |           |  |
    |  +---------------------+  |
    |  start ->                 |
    +---------------------------+  z = -5
  x = -6                      x = 6
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.cli.main import console
from torchslam.data.synthetic.scene import (
    BUILDING_TEXEL,
    FLOOR,
    HEIGHT,
    PARTITION,
    Painter,
    Rectangle,
    Vector,
    X,
    Y,
    Z,
)
from torchslam.data.synthetic.sequence import SCENES, Scene, poses

TOP = np.array((0.0, -HEIGHT / 2, 0.0))
STOREY_OUTER = (6.0, 5.0)
"""Meters from the center to the outer walls, along x and z."""
STOREY_CORE = (4.2, 3.2)
"""Meters from the center to the inner walls of the corridor."""
STOREY_ROOM = (0.4, 4.1, -2.4, 2.4)
"""x from and to, z from and to."""
STOREY_DOOR = (-0.6, 0.6)
"""Begin and end of the door along z."""
STOREY_DOOR_TOP = -0.75
PLAIN = 0.03
"""Coverage of a wall of the corridor by the largest shapes: an eighth of that of other surfaces."""
BOARD_EVERY = 3.2
"""Meters along the corridor between two notice boards, on one wall and on the other."""
BOARD = (0.6, 0.9, 0.03)
"""Width, height and depth of one: up to that share larger or smaller by `SPREAD`."""
SPREAD = 0.3

STOREY_FURNITURE = (
    (
        (0.75, 0.45, -1.2),
        (0.4, 1.9, 1.4),
        0.0,
    ),  # along the wall that faces the door: shelves, a table, a box on it
    ((0.7, 0.95, 0.5), (0.6, 0.9, 1.1), 0.0),
    ((0.7, 0.35, 0.6), (0.3, 0.3, 0.35), 0.4),
    ((1.3, 0.5, 2.1), (1.1, 1.8, 0.4), -0.2),  # a cupboard and a chest along the side walls
    ((2.9, 0.9, 2.05), (0.9, 1.0, 0.5), 0.1),
    ((1.6, 0.8, -2.1), (1.2, 1.2, 0.4), 0.1),
    ((3.2, 1.0, -1.95), (0.6, 0.8, 0.6), 0.5),
    ((2.0, -1.1, 1.2), (0.5, 0.3, 0.5), 0.3),  # lamps
    ((2.2, -1.1, -1.2), (0.4, 0.4, 0.4), -0.5),
)
"""Center, size and turn of each piece in the room."""

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


def storey(seed: int) -> list[Rectangle]:
    """12 x 2.8 x 10 meters around the origin; textures from a seed."""
    painter = Painter(np.random.default_rng(seed), BUILDING_TEXEL)
    plain = replace(painter, coverage=PLAIN)
    return _corridor(plain) + _boards(painter) + _storey_room(painter, plain)


def _corridor(plain: Painter) -> list[Rectangle]:
    """Its ceiling and FLOOR, which the room has as well, the outer walls, three of the core's."""
    x, z = STOREY_OUTER
    core_x, core_z = STOREY_CORE
    lengths = (2 * x, 2 * z)
    corner = TOP + np.array((-x, 0.0, -z))
    inner = TOP + np.array((-core_x, 0.0, -core_z))
    return [
        plain.rectangle(corner, X, Z, lengths),
        plain.rectangle(corner + HEIGHT * Y, X, Z, lengths),
        *(plain.rectangle(corner + far * Z, X, Y, (2 * x, HEIGHT)) for far in (0.0, 2 * z)),
        *(plain.rectangle(corner + far * X, Z, Y, (2 * z, HEIGHT)) for far in (0.0, 2 * x)),
        *(plain.rectangle(inner + far * Z, X, Y, (2 * core_x, HEIGHT)) for far in (0.0, 2 * core_z)),
        plain.rectangle(inner, Z, Y, (2 * core_z, HEIGHT)),
    ]


def _boards(painter: Painter) -> list[Rectangle]:
    """Notice boards on all walls of the corridor, at the door one that faces it."""
    rectangles = []
    for half, across in zip(STOREY_OUTER, STOREY_OUTER[::-1], strict=True):
        runs_along_x = half == STOREY_OUTER[0]
        for wall in (across, STOREY_CORE[1 if runs_along_x else 0]):
            is_outer = wall == across
            for side in (-1.0, 1.0):
                reach = half - 0.6 if is_outer else (STOREY_CORE[0] if runs_along_x else STOREY_CORE[1]) - 0.5
                for along in np.arange(-reach, reach + 1e-9, 2 * reach / round(2 * reach / BOARD_EVERY)):
                    inward = -0.5 * BOARD[2] if is_outer else 0.5 * BOARD[2]
                    at = (along + painter.rng.uniform(-SPREAD, SPREAD), side * (wall + inward))
                    if (
                        not runs_along_x
                        and side > 0
                        and not is_outer
                        and abs(at[0]) < STOREY_DOOR[1] + BOARD[0]
                    ):
                        continue
                    rectangles += _board(painter, at, runs_along_x)
    return rectangles + _board(painter, (0.0, STOREY_OUTER[0] - 0.02), False)


def _board(painter: Painter, at: tuple[float, float], runs_along_x: bool) -> list[Rectangle]:
    """at: how far along its wall, and where that is."""
    width, height = np.array(BOARD[:2]) * painter.rng.uniform(1 - SPREAD, 1 + SPREAD, 2)
    y = painter.rng.uniform(-0.5, 0.2)
    center: Vector = (at[0], y, at[1]) if runs_along_x else (at[1], y, at[0])
    size: Vector = (width, height, BOARD[2]) if runs_along_x else (BOARD[2], height, width)
    return painter.box(center, size, 0.0)


def _storey_room(painter: Painter, plain: Painter) -> list[Rectangle]:
    """Its walls, the wall with the door, the furniture."""
    x0, x1, z0, z1 = STOREY_ROOM
    corner = TOP + np.array((x0, 0.0, z0))
    rectangles = [
        painter.rectangle(corner, Z, Y, (z1 - z0, HEIGHT)),
        painter.rectangle(corner, X, Y, (x1 - x0, HEIGHT)),
        painter.rectangle(corner + (z1 - z0) * Z, X, Y, (x1 - x0, HEIGHT)),
    ]
    middle = STOREY_CORE[0] - PARTITION / 2
    for start, end, bottom in (
        (-STOREY_CORE[1], STOREY_DOOR[0], FLOOR),
        (STOREY_DOOR[1], STOREY_CORE[1], FLOOR),
        (*STOREY_DOOR, STOREY_DOOR_TOP),
    ):
        center = (middle, (bottom - FLOOR) / 2, (start + end) / 2)
        rectangles += plain.box(center, (PARTITION, bottom + FLOOR, end - start), 0.0)
    for center, size, turn in STOREY_FURNITURE:
        rectangles += painter.box(center, size, turn)
    return rectangles


def round_the_storey(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """Around the corridor of the storey and into its room, one round a phase of 2 pi; the body turns in place.

    The camera is held at arm's length and looks ahead, it sways and glances to the sides.
    """
    x, z, yaw = _walked(phase)
    yaw = yaw + 0.15 * torch.sin(17.3 * phase) + 0.015 * torch.sin(61.7 * phase)
    return poses(
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


# A corridor all around with a room on the way, and 100 frames on, over the start.
SCENES["storey"] = Scene(storey, round_the_storey, 1160, 1260)

if __name__ == "__main__":
    console()
