"""Scenes of textured rectangles: procedural textures with corners at every scale, a furnished room, a wall, a building.

The building has four rooms around a core, which are rooms of their own, or all the same. Seen from above, the first
room is the quarter x < 0, z > 0; the others are that quarter turned to the right about the vertical axis by 90, 180 and
270 degrees. One enters a room through the door in its plane z = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

COVERAGE = 0.25  # the part of a surface that the largest shapes cover
KINDS = ("polygon", "bar", "ellipse", "letter")
MIN_CONTRAST = 30  # gray levels between a shape and what is below its center
FRACTION_BITS = 4  # factor of the coordinates of polygons, so that their corners lie off the pixel grid


def surface(
    rng: np.random.Generator,
    size: tuple[float, float],
    texel: float,
    multiple: int,
    coverage: float = COVERAGE,
) -> np.ndarray:
    """A painted surface: shapes of every size from a third of it down to two centimeters, over smooth noise.

    Size, width and height, and texels, at most so large, are in meters; `multiple` divides the numbers of rows and
    columns; the largest shapes cover a fraction of the surface.
    """
    columns, rows = (multiple * math.ceil(length / texel / multiple) for length in size)
    image = _noise(rng, rows, columns, texel)
    extent = largest = min(size) / 3
    while extent > 0.02:
        # The small ones leave more room, so that what is below them stays visible.
        share = coverage * (extent / largest) ** 0.5
        count = int(share * size[0] * size[1] / (0.3 * extent**2)) + 1
        _draw_shapes(rng, image, count, extent / texel)
        extent /= 1.7
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def _noise(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """Noise of several octaves around a tone of the surface's own, (rows, columns) uint8."""
    total = np.full((rows, columns), rng.uniform(105, 165), np.float32)
    for wavelength, amplitude in ((0.9, 30.0), (0.2, 15.0), (0.05, 10.0), (0.015, 8.0)):
        cells = (max(2, int(rows * texel / wavelength)), max(2, int(columns * texel / wavelength)))
        coarse = rng.uniform(-amplitude, amplitude, cells).astype(np.float32)
        total += cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)
    return total.clip(0, 255).astype(np.uint8)


def _draw_shapes(rng: np.random.Generator, image: np.ndarray, count: int, extent: float) -> None:
    """Draw `count` random shapes of about `extent` texels, each lighter or darker than what is below it."""
    rows, columns = image.shape
    kinds = rng.choice(len(KINDS), count, p=(0.45, 0.25, 0.15, 0.15))
    centers = rng.uniform((0, 0), (columns, rows), (count, 2))
    radii = 0.5 * extent * rng.uniform(0.6, 1.4, count)
    contrasts = rng.uniform(35, 95, count) * rng.choice((-1, 1), count)
    turns = rng.uniform(0, 2 * np.pi, count)
    aspects = rng.uniform(0.3, 1.0, count)
    letters = rng.integers(ord("A"), ord("Z") + 1, count)
    corners = rng.integers(3, 7, count)
    jitters = rng.uniform(-0.35, 0.35, (count, 6))
    # The outlines of polygons and bars, all at once: (count, 6, 2), of which the first `sides` are corners.
    is_bar = kinds == KINDS.index("bar")
    sides = np.where(is_bar, 4, corners)
    angles = 2 * np.pi * (np.arange(6) + np.where(is_bar[:, None], 0, jitters)) / sides[:, None]
    outlines = np.stack((np.cos(angles), np.sin(angles) * aspects[:, None]), axis=-1) * radii[:, None, None]
    cosine, sine = np.cos(turns), np.sin(turns)
    rotations = np.stack((np.stack((cosine, sine), axis=-1), np.stack((-sine, cosine), axis=-1)), axis=-2)
    fixed = ((outlines @ rotations + centers[:, None]) * 2**FRACTION_BITS).round().astype(np.int32)
    for i, ((x, y), contrast, radius) in enumerate(
        zip(centers.tolist(), contrasts.tolist(), radii.tolist(), strict=True)
    ):
        below = int(image[int(y), int(x)])
        gray = int(min(max(below + contrast, 0), 255))
        if abs(gray - below) < MIN_CONTRAST:  # the other way, since this one is cut off
            gray = int(min(max(below - contrast, 0), 255))
        kind = KINDS[kinds[i]]
        if kind == "letter":
            corner, font = (int(x - 0.6 * radius), int(y + 0.7 * radius)), cv2.FONT_HERSHEY_SIMPLEX
            thickness = max(1, round(radius / 4))
            cv2.putText(image, chr(letters[i]), corner, font, radius / 14, gray, thickness, cv2.LINE_AA)
        elif kind == "ellipse":
            axes = (max(1.0, 2 * radius), max(1.0, 2 * radius * aspects[i]))
            cv2.ellipse(image, ((x, y), axes, math.degrees(turns[i])), gray, -1, cv2.LINE_AA)
        else:
            cv2.fillPoly(image, [fixed[i, : sides[i]]], gray, cv2.LINE_AA, FRACTION_BITS)


Vector = tuple[float, float, float]
X, Y, Z = np.eye(3)  # axes of the world: right, down, forward
TEXEL = 0.003  # meters: finer than a pixel sees from a meter away
MIP_LEVELS = 6  # sizes a texture is kept at; its sides halve without remainder that often


@dataclass(frozen=True)
class Rectangle:
    """A textured rectangle in the world, meters: its corner where the texture starts (3,) and its size along u and v.

    The unit vectors u and v (3,) are along the columns and rows of the texture (rows, columns), uint8.
    """

    origin: np.ndarray
    axis_u: np.ndarray
    axis_v: np.ndarray
    size: tuple[float, float]
    texture: np.ndarray


@dataclass(frozen=True)
class Painter:
    """Builds rectangles with individual textures, as `surface`, lit from above and slightly from the front."""

    rng: np.random.Generator
    texel: float = TEXEL
    coverage: float = COVERAGE

    def rectangle(
        self, origin: np.ndarray, axis_u: np.ndarray, axis_v: np.ndarray, size: tuple[float, float]
    ) -> Rectangle:
        """Return a rectangle with a new texture; `size` is in meters along its axes."""
        texture = surface(self.rng, size, self.texel, 2 ** (MIP_LEVELS - 1), self.coverage)
        normal = np.cross(axis_u, axis_v)
        light = 0.8 + 0.15 * abs(float(normal @ Z)) + 0.2 * float(abs(normal @ Y))
        return Rectangle(origin, axis_u, axis_v, size, (texture * min(light, 1.0)).astype(np.uint8))

    def box(self, center: Vector, size: Vector, turn: float) -> list[Rectangle]:
        """The six sides of a box, turned about the vertical axis by `turn` radians."""
        rotation = np.array(((np.cos(turn), 0, np.sin(turn)), (0, 1, 0), (-np.sin(turn), 0, np.cos(turn))))
        axes = (rotation @ X, Y, rotation @ Z)
        sides = []
        for a, b, c in ((0, 1, 2), (2, 1, 0), (0, 2, 1)):
            corner = np.array(center) - 0.5 * (size[a] * axes[a] + size[b] * axes[b])
            for end in (-0.5, 0.5):
                origin = corner + end * size[c] * axes[c]
                sides.append(self.rectangle(origin, axes[a], axes[b], (size[a], size[b])))
        return sides


def room(seed: int) -> list[Rectangle]:
    """A room of 6.4 x 2.8 x 5.6 meters (x, y down, z) around the origin, furniture in its far half."""
    painter = Painter(np.random.default_rng(seed))
    rectangles = painter.box((0, 0, 0), (6.4, 2.8, 5.6), 0.0)
    furniture = (
        ((-1.9, 0.95, 1.7), (1.2, 0.9, 0.7), 0.3),  # a table to the left, with two boxes on it
        ((-2.1, 0.35, 1.75), (0.4, 0.3, 0.3), 0.8),
        ((-1.6, 0.4, 1.65), (0.25, 0.2, 0.35), -0.4),
        ((0.2, 1.0, 2.1), (1.0, 0.8, 0.6), -0.2),  # a chest in the middle, with a box on it
        ((0.35, 0.4, 2.1), (0.5, 0.4, 0.3), 0.5),
        ((2.1, 0.5, 1.9), (0.7, 1.8, 0.6), -0.6),  # a cupboard in the right corner
        ((1.2, 1.15, 1.3), (0.4, 0.5, 0.4), 0.9),  # stools
        ((-0.8, 1.1, 1.3), (0.35, 0.6, 0.35), 0.2),
        ((-0.9, -0.75, 1.9), (0.5, 0.5, 0.2), 0.4),  # lamps that hang from the ceiling
        ((1.1, -0.9, 1.6), (0.4, 0.4, 0.4), -0.3),
        ((-2.6, 0.3, -0.6), (0.6, 2.2, 1.2), 0.1),  # shelves at the sides
        ((2.7, 0.5, 0.1), (0.5, 1.8, 1.0), -0.1),
    )
    for center, size, turn in furniture:
        rectangles += painter.box(center, size, turn)
    return rectangles


def wall(seed: int) -> list[Rectangle]:
    """A single wall of 9 x 6 meters, 2.5 meters in front of the origin."""
    painter = Painter(np.random.default_rng(seed))
    return [painter.rectangle(np.array((-4.5, -3.0, 2.5)), X, Y, (9.0, 6.0))]


HEIGHT = 2.8  # meters from floor to ceiling, as all below
FLOOR = HEIGHT / 2  # y points down, and is 0 half-way up
PARTITION = 0.1  # thickness of a wall with a door
BUILDING_TEXEL = 0.004  # walls and furniture are hardly ever nearer than two pixels to that
ROOMS_HALF, ROOMS_CORE = 3.9, 1.3  # from the center to the outer and the inner walls
ROOMS_DOOR = (-3.4, -1.95)  # begin and end along x
SIZE_SPREAD, TURN_SPREAD = 0.12, 0.15
"""Furniture is up to that share larger or smaller, and turned by up to that many radians from its place."""
QUARTER_TURN = np.array(((0.0, 0, 1), (0, 1, 0), (-1, 0, 0)))  # about y, to the right: z becomes x

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
    painter = Painter(np.random.default_rng(seed), BUILDING_TEXEL)
    return [rectangle for turns in range(4) for rectangle in _turned(_quarter(painter), turns)]


def corridors(seed: int) -> list[Rectangle]:
    """The same building with one room four times: from corresponding places, all four look the same."""
    room = _quarter(Painter(np.random.default_rng(seed), BUILDING_TEXEL))
    return [rectangle for turns in range(4) for rectangle in _turned(room, turns)]


def _quarter(painter: Painter) -> list[Rectangle]:
    """The first room: its part of the shell, the wall with the door, the furniture."""
    corner = np.array((-ROOMS_HALF, -FLOOR, 0.0))
    core = np.array((-ROOMS_CORE, -FLOOR, 0.0))
    rectangles = [
        painter.rectangle(corner, X, Z, (ROOMS_HALF, ROOMS_HALF)),  # ceiling
        painter.rectangle(corner + HEIGHT * Y, X, Z, (ROOMS_HALF, ROOMS_HALF)),  # floor
        painter.rectangle(corner, Z, Y, (ROOMS_HALF, HEIGHT)),
        painter.rectangle(corner + ROOMS_HALF * Z, X, Y, (ROOMS_HALF, HEIGHT)),
        painter.rectangle(core, Z, Y, (ROOMS_CORE, HEIGHT)),
        painter.rectangle(core + ROOMS_CORE * Z, X, Y, (ROOMS_CORE, HEIGHT)),
    ]
    for start, end, bottom in (  # of the wall in the plane z = 0: on each side of the door, and above it
        (-ROOMS_HALF, ROOMS_DOOR[0], FLOOR),
        (ROOMS_DOOR[1], -ROOMS_CORE, FLOOR),
        (*ROOMS_DOOR, -0.7),
    ):
        center = ((start + end) / 2, (bottom - FLOOR) / 2, 0.0)
        rectangles += painter.box(center, (end - start, bottom + FLOOR, PARTITION), 0.0)
    for center, size, turn in ROOMS_FURNITURE:
        x, y, z = np.array(size) * painter.rng.uniform(1 - SIZE_SPREAD, 1 + SIZE_SPREAD, 3)
        turn += painter.rng.uniform(-TURN_SPREAD, TURN_SPREAD)
        rectangles += painter.box(center, (x, y, z), turn)
    return rectangles


def _turned(rectangles: list[Rectangle], turns: int) -> list[Rectangle]:
    """The same rectangles, textures shared, after this number of quarter turns."""
    R = np.linalg.matrix_power(QUARTER_TURN, turns)
    return [
        Rectangle(R @ one.origin, R @ one.axis_u, R @ one.axis_v, one.size, one.texture) for one in rectangles
    ]
