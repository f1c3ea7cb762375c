"""A building to walk around in: four rooms around a core.

The four rooms are rooms of their own, or all the same. Seen from above, the first room is the quarter x < 0, z > 0; the
others are that quarter turned to the right about the vertical axis by 90, 180 and 270 degrees. One enters a room
through the door in its plane z = 0.
"""

from __future__ import annotations

import numpy as np

from torchslam.data.synthetic.scene import Painter, Rectangle, X, Y, Z

HEIGHT = 2.8
"""Meters from floor to ceiling."""
FLOOR = HEIGHT / 2
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
