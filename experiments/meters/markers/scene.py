"""`synthetic:marked`: the furnished room with AprilTags, a ChArUco board and a chessboard; importing this adds it.

Four tags of the family 36h11 with sides of 0.16 m, numbered 0 to 3, and tag 9 with sides of 0.2 m; boards of 7 x 5
squares of 0.08 m, the ChArUco board with markers of 0.06 m.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from torchslam.data.synthetic.paths import loop
from torchslam.data.synthetic.scene import Rectangle, Vector, room
from torchslam.data.synthetic.sequence import SCENES, Scene

WHITE, BLACK = 225, 25
CELL = 32
"""Texels of a cell of a marker; sides of textures must be a multiple of it."""
SQUARE = 64
"""Texels of a square of a board."""
TAG_PLACES: dict[int, tuple[Vector, float, float]] = {
    0: ((-1.2, -0.25, 1.2), 0.35, 0.1),
    1: ((-0.35, -0.55, 1.5), 0.1, -0.15),
    2: ((0.45, -0.1, 1.3), -0.3, 0.05),
    3: ((1.5, -0.2, 1.5), -0.5, -0.1),
    9: ((0.1, 0.3, 1.1), 0.2, 0.2),
}
"""Center in meters, turn about the vertical and tilt in radians, by id."""
LARGE_TAG = 9
TAG_SIDE, LARGE_SIDE = 0.16, 0.2
CHARUCO_PLACE = (-0.55, 0.1, 1.6), 0.3, 0.15
CHESSBOARD_PLACE = (0.95, 0.25, 1.7), -0.35, -0.1
SQUARES = (7, 5)
SQUARE_SIDE, MARKER_SIDE = 0.08, 0.06


def marked_room(seed: int) -> list[Rectangle]:
    """The room with the targets in front of its furniture."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    rectangles = room(seed)
    for identity, place in TAG_PLACES.items():
        drawn = cv2.aruco.generateImageMarker(tags, identity, 8 * CELL)
        side = LARGE_SIDE if identity == LARGE_TAG else TAG_SIDE
        rectangles.append(_panel(drawn, side / (8 * CELL), CELL, *place))
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE_SIDE, MARKER_SIDE, family)
    columns, rows = SQUARES
    charuco = board.generateImage((columns * SQUARE, rows * SQUARE))
    squares = np.indices((rows * SQUARE, columns * SQUARE)) // SQUARE
    chessboard = np.where(squares.sum(axis=0) % 2, 255, 0)
    texel = SQUARE_SIDE / SQUARE
    rectangles.append(_panel(charuco, texel, CELL, *CHARUCO_PLACE))
    rectangles.append(_panel(chessboard, texel, CELL, *CHESSBOARD_PLACE))
    return rectangles


def _panel(
    drawn: np.ndarray, texel: float, margin: int, center: Vector, turn: float, tilt: float
) -> Rectangle:
    """A print with a white margin of so many texels, each of so many meters."""
    padded = cv2.copyMakeBorder(
        np.where(drawn > 127, WHITE, BLACK).astype(np.uint8), *[margin] * 4, cv2.BORDER_CONSTANT, value=WHITE
    )
    axis_u = np.array((math.cos(turn), 0.0, math.sin(turn)))
    ahead = np.array((-math.sin(turn), 0.0, math.cos(turn)))
    axis_v = np.array((0.0, math.cos(tilt), 0.0)) + math.sin(tilt) * ahead
    size = (texel * padded.shape[1], texel * padded.shape[0])
    origin = np.array(center) - size[0] / 2 * axis_u - size[1] / 2 * axis_v
    return Rectangle(origin, axis_u, axis_v, size, padded)


SCENES["marked"] = Scene(marked_room, loop)
