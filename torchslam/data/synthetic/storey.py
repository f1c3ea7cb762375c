"""A storey: a corridor all around a core, weak in texture, and in the core a furnished room that one goes into.

Seen from above, x to the right and z up the page:

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

from dataclasses import replace

import numpy as np

from torchslam.data.synthetic.scene import Painter, Rectangle, Vector, X, Y, Z

OUTER = (6.0, 5.0)
"""Meters from the center to the outer walls, along x and z."""
CORE = (4.2, 3.2)
"""Meters from the center to the inner walls of the corridor."""
HEIGHT = 2.8
TOP = np.array((0.0, -HEIGHT / 2, 0.0))
"""y points down, and is 0 half-way up."""
ROOM = (0.4, 4.1, -2.4, 2.4)
"""x from and to, z from and to."""
DOOR = (-0.6, 0.6)
"""Where the door begins and ends along z."""
DOOR_TOP = -0.75
WALL = 0.1
"""Thickness of the wall with the door."""
TEXEL = 0.004
"""Meters: hardly anything is ever nearer than two pixels to that."""
PLAIN = 0.03
"""Of a wall of the corridor: the largest shapes cover an eighth of what they cover elsewhere."""
BOARD_EVERY = 3.2
"""Meters along the corridor between two notice boards, on one wall and on the other."""
BOARD = (0.6, 0.9, 0.03)
"""Width, height and depth of one: up to that share larger or smaller by `SPREAD`."""
SPREAD = 0.3

FURNITURE = (
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


def storey(seed: int) -> list[Rectangle]:
    """12 x 2.8 x 10 meters around the origin; textures from a seed."""
    painter = Painter(np.random.default_rng(seed), TEXEL)
    plain = replace(painter, coverage=PLAIN)
    return _corridor(plain) + _boards(painter) + _room(painter, plain)


def _corridor(plain: Painter) -> list[Rectangle]:
    """Its ceiling and floor, which the room has as well, the outer walls, three of the core's."""
    x, z = OUTER
    core_x, core_z = CORE
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
    for half, across in zip(OUTER, OUTER[::-1], strict=True):
        runs_along_x = half == OUTER[0]
        for wall in (across, CORE[1 if runs_along_x else 0]):
            is_outer = wall == across
            for side in (-1.0, 1.0):
                reach = half - 0.6 if is_outer else (CORE[0] if runs_along_x else CORE[1]) - 0.5
                for along in np.arange(-reach, reach + 1e-9, 2 * reach / round(2 * reach / BOARD_EVERY)):
                    inward = -0.5 * BOARD[2] if is_outer else 0.5 * BOARD[2]
                    at = (along + painter.rng.uniform(-SPREAD, SPREAD), side * (wall + inward))
                    if not runs_along_x and side > 0 and not is_outer and abs(at[0]) < DOOR[1] + BOARD[0]:
                        continue
                    rectangles += _board(painter, at, runs_along_x)
    return rectangles + _board(painter, (0.0, OUTER[0] - 0.02), False)


def _board(painter: Painter, at: tuple[float, float], runs_along_x: bool) -> list[Rectangle]:
    """at: how far along its wall, and where that is."""
    width, height = np.array(BOARD[:2]) * painter.rng.uniform(1 - SPREAD, 1 + SPREAD, 2)
    y = painter.rng.uniform(-0.5, 0.2)
    center: Vector = (at[0], y, at[1]) if runs_along_x else (at[1], y, at[0])
    size: Vector = (width, height, BOARD[2]) if runs_along_x else (BOARD[2], height, width)
    return painter.box(center, size, 0.0)


def _room(painter: Painter, plain: Painter) -> list[Rectangle]:
    """Its walls, the wall with the door, the furniture."""
    x0, x1, z0, z1 = ROOM
    corner = TOP + np.array((x0, 0.0, z0))
    rectangles = [
        painter.rectangle(corner, Z, Y, (z1 - z0, HEIGHT)),
        painter.rectangle(corner, X, Y, (x1 - x0, HEIGHT)),
        painter.rectangle(corner + (z1 - z0) * Z, X, Y, (x1 - x0, HEIGHT)),
    ]
    middle = CORE[0] - WALL / 2
    floor = HEIGHT / 2
    for start, end, bottom in ((-CORE[1], DOOR[0], floor), (DOOR[1], CORE[1], floor), (*DOOR, DOOR_TOP)):
        center = (middle, (bottom - floor) / 2, (start + end) / 2)
        rectangles += plain.box(center, (WALL, bottom + floor, end - start), 0.0)
    for center, size, turn in FURNITURE:
        rectangles += painter.box(center, size, turn)
    return rectangles
