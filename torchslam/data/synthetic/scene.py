"""Scenes of textured rectangles: a furnished room, a single wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchslam.data.synthetic.textures import COVERAGE, surface

Vector = tuple[float, float, float]
X, Y, Z = np.eye(3)
TEXEL = 0.003
"""Meters: finer than a pixel sees from a meter away."""
MIP_LEVELS = 6
"""Sizes a texture is kept at; its sides halve without remainder that often."""


@dataclass(frozen=True)
class Rectangle:
    """A textured rectangle in the world, meters.

    origin: (3,) the corner where the texture starts
    axis_u, axis_v: (3,) unit vectors along the texture's columns and rows
    size:   (along u, along v)
    texture: (rows, columns) uint8
    """

    origin: np.ndarray
    axis_u: np.ndarray
    axis_v: np.ndarray
    size: tuple[float, float]
    texture: np.ndarray


@dataclass(frozen=True)
class Painter:
    """Makes rectangles, each with a texture of its own, lit from above and a little from the front.

    rng:   of the textures
    texel: meters, at most
    coverage: the part of a surface that the largest shapes cover
    """

    rng: np.random.Generator
    texel: float = TEXEL
    coverage: float = COVERAGE

    def rectangle(
        self, origin: np.ndarray, axis_u: np.ndarray, axis_v: np.ndarray, size: tuple[float, float]
    ) -> Rectangle:
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
