"""Buildings to walk around in: four rooms around a core, and a storey with a corridor and one room.

The four rooms are rooms of their own, or all the same. Seen from above, the first room is the quarter x < 0, z > 0; the
others are that quarter turned to the right about the vertical axis by 90, 180 and 270 degrees. One enters a room
through the door in its plane z = 0.

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

from dataclasses import replace

import numpy as np

from torchslam.data.synthetic.scene import Painter, Rectangle, Vector, X, Y, Z

HEIGHT = 2.8
"""Meters from floor to ceiling."""
FLOOR = HEIGHT / 2
"""y of the floor, meters; y points down, and the camera moves at half the height."""
TOP = np.array((0.0, -HEIGHT / 2, 0.0))
"""y points down, and is 0 half-way up."""
PARTITION = 0.1
"""Thickness of a wall with a door."""
TEXEL = 0.004
"""Meters: walls and furniture are hardly ever nearer than two pixels to that."""

ROOMS_HALF = 3.9
"""Meters from the center to the outer walls."""
ROOMS_CORE = 1.3
"""Meters from the center to the inner walls."""
ROOMS_DOOR = (-3.4, -1.95)
"""Begin and end of the door along x."""
ROOMS_DOOR_TOP = -0.7
"""y of the upper edge of the doors, meters."""
SIZE_SPREAD = 0.12
"""Furniture is up to that share larger or smaller ..."""
TURN_SPREAD = 0.15
"""... and turned by up to that many radians from its place."""
QUARTER_TURN = np.array(((0.0, 0, 1), (0, 1, 0), (-1, 0, 0)))
"""About y, to the right: z becomes x."""

ROOMS_FURNITURE = (
    ((-3.65, 0.95, 1.0), (0.4, 0.9, 0.9), 0.0),  # along the wall to the left: a chest with a box on it, ...
    ((-3.65, 0.35, 0.9), (0.3, 0.3, 0.35), 0.3),
    ((-3.6, 0.45, 2.2), (0.4, 1.9, 0.7), 0.0),  # ... a shelf
    ((-3.35, 0.45, 3.35), (1.1, 1.9, 0.4), -0.8),  # a cupboard across the corner
    ((-2.2, 1.05, 3.55), (0.9, 0.7, 0.5), 0.0),  # along the wall ahead: a table with two boxes on it, ...
    ((-2.4, 0.5, 3.6), (0.3, 0.4, 0.25), -0.4),
    ((-2.0, 0.6, 3.55), (0.25, 0.2, 0.3), 0.6),
    ((-0.9, 0.65, 3.65), (0.7, 1.5, 0.35), 0.0),  # ... another shelf
    ((-1.52, 1.2, 1.0), (0.35, 0.4, 0.35), 0.1),  # stools at the core
    ((-0.7, 1.15, 1.55), (0.4, 0.5, 0.35), -0.1),
    ((-3.1, -1.1, 1.5), (0.4, 0.4, 0.4), 0.5),  # lamps that hang from the ceiling
    ((-1.5, -1.15, 3.1), (0.5, 0.3, 0.3), 0.3),
)
"""Center, size and turn of each piece in the first room."""

STOREY_OUTER = (6.0, 5.0)
"""Meters from the center to the outer walls, along x and z."""
STOREY_CORE = (4.2, 3.2)
"""Meters from the center to the inner walls of the corridor."""
STOREY_ROOM = (0.4, 4.1, -2.4, 2.4)
"""x from and to, z from and to."""
STOREY_DOOR = (-0.6, 0.6)
"""Begin and end of the door along z."""
STOREY_DOOR_TOP = -0.75
"""y of the upper edge of the doors, meters."""
PLAIN = 0.03
"""Coverage of a wall of the corridor by the largest shapes: an eighth of that of other surfaces."""
BOARD_EVERY = 3.2
"""Meters along the corridor between two notice boards, on one wall and on the other."""
BOARD = (0.6, 0.9, 0.03)
"""Width, height and depth of one: up to that share larger or smaller by `SPREAD`."""
SPREAD = 0.3
"""Meters along the wall, and ratio of the size, by which a notice board differs from the regular one."""

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


def rooms(seed: int) -> list[Rectangle]:
    """Four rooms with textures and furniture of their own, 7.8 x 2.8 x 7.8 meters in all, around the origin."""
    painter = Painter(np.random.default_rng(seed), TEXEL)
    return [rectangle for turns in range(4) for rectangle in _turned(_quarter(painter), turns)]


def corridors(seed: int) -> list[Rectangle]:
    """The same building with one room four times: from corresponding places, all four look the same."""
    room = _quarter(Painter(np.random.default_rng(seed), TEXEL))
    return [rectangle for turns in range(4) for rectangle in _turned(room, turns)]


def _quarter(painter: Painter) -> list[Rectangle]:
    """The first room: its part of the shell, the wall with the door, the furniture."""
    return _shell(painter) + _doorway(painter) + _furniture(painter)


def _shell(painter: Painter) -> list[Rectangle]:
    corner = np.array((-ROOMS_HALF, -FLOOR, 0.0))
    core = np.array((-ROOMS_CORE, -FLOOR, 0.0))
    return [
        painter.rectangle(corner, X, Z, (ROOMS_HALF, ROOMS_HALF)),  # ceiling
        painter.rectangle(corner + HEIGHT * Y, X, Z, (ROOMS_HALF, ROOMS_HALF)),  # floor
        painter.rectangle(corner, Z, Y, (ROOMS_HALF, HEIGHT)),
        painter.rectangle(corner + ROOMS_HALF * Z, X, Y, (ROOMS_HALF, HEIGHT)),
        painter.rectangle(core, Z, Y, (ROOMS_CORE, HEIGHT)),
        painter.rectangle(core + ROOMS_CORE * Z, X, Y, (ROOMS_CORE, HEIGHT)),
    ]


def _doorway(painter: Painter) -> list[Rectangle]:
    """The wall in the plane z = 0: a piece on each side of the door, one above it."""
    rectangles = []
    for start, end, bottom in (
        (-ROOMS_HALF, ROOMS_DOOR[0], FLOOR),
        (ROOMS_DOOR[1], -ROOMS_CORE, FLOOR),
        (*ROOMS_DOOR, ROOMS_DOOR_TOP),
    ):
        center = ((start + end) / 2, (bottom - FLOOR) / 2, 0.0)
        rectangles += painter.box(center, (end - start, bottom + FLOOR, PARTITION), 0.0)
    return rectangles


def _furniture(painter: Painter) -> list[Rectangle]:
    rectangles = []
    for center, size, turn in ROOMS_FURNITURE:
        x, y, z = np.array(size) * painter.rng.uniform(1 - SIZE_SPREAD, 1 + SIZE_SPREAD, 3)
        turn += painter.rng.uniform(-TURN_SPREAD, TURN_SPREAD)
        rectangles += painter.box(center, (x, y, z), turn)
    return rectangles


def _turned(rectangles: list[Rectangle], turns: int) -> list[Rectangle]:
    """The same rectangles, textures shared, after so many quarter turns."""
    R = np.linalg.matrix_power(QUARTER_TURN, turns)
    return [
        Rectangle(R @ one.origin, R @ one.axis_u, R @ one.axis_v, one.size, one.texture) for one in rectangles
    ]


def storey(seed: int) -> list[Rectangle]:
    """12 x 2.8 x 10 meters around the origin; textures from a seed."""
    painter = Painter(np.random.default_rng(seed), TEXEL)
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
