"""Furnished rooms with printed targets; importing this module adds the scenes.

`synthetic:tags` has four AprilTags of the family 36h11 with sides of 0.16 m, numbered 0 to 3, and tag 9 with sides of
0.2 m; `synthetic:charuco` and `synthetic:chessboard` have a board of 7 x 5 squares of 0.12 m, markers of 0.09 m.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from torchslam.data.synthetic.scene import Rectangle, Vector, room
from torchslam.data.synthetic.sequence import SCENES, Scene, loop

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
BOARD_PLACE = (0.1, 0.1, 1.5), 0.35, 0.2
SQUARES = (7, 5)
SQUARE_SIDE, MARKER_SIDE = 0.12, 0.09


def room_with_tags(seed: int) -> list[Rectangle]:
    """The room with tags in front of its furniture."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    rectangles = room(seed)
    for identity, place in TAG_PLACES.items():
        drawn = cv2.aruco.generateImageMarker(tags, identity, 8 * CELL)
        side = LARGE_SIDE if identity == LARGE_TAG else TAG_SIDE
        rectangles.append(_panel(drawn, side / (8 * CELL), *place))
    return rectangles


def room_with_charuco(seed: int) -> list[Rectangle]:
    """The room with a ChArUco board."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE_SIDE, MARKER_SIDE, family)
    drawn = board.generateImage((SQUARES[0] * SQUARE, SQUARES[1] * SQUARE))
    return [*room(seed), _panel(drawn, SQUARE_SIDE / SQUARE, *BOARD_PLACE)]


def room_with_chessboard(seed: int) -> list[Rectangle]:
    """The room with a chessboard."""
    squares = np.indices((SQUARES[1] * SQUARE, SQUARES[0] * SQUARE)) // SQUARE
    drawn = np.where(squares.sum(axis=0) % 2, 255, 0)
    return [*room(seed), _panel(drawn, SQUARE_SIDE / SQUARE, *BOARD_PLACE)]


def _panel(drawn: np.ndarray, texel: float, center: Vector, turn: float, tilt: float) -> Rectangle:
    """A print of so many meters a texel, with a white margin."""
    padded = np.pad(np.where(drawn > 127, WHITE, BLACK).astype(np.uint8), CELL, constant_values=WHITE)
    axis_u = np.array((math.cos(turn), 0.0, math.sin(turn)))
    ahead = np.array((-math.sin(turn), 0.0, math.cos(turn)))
    axis_v = np.array((0.0, math.cos(tilt), 0.0)) + math.sin(tilt) * ahead
    size = (texel * padded.shape[1], texel * padded.shape[0])
    origin = np.array(center) - size[0] / 2 * axis_u - size[1] / 2 * axis_v
    return Rectangle(origin, axis_u, axis_v, size, padded)


SCENES["tags"] = Scene(room_with_tags, loop)
SCENES["charuco"] = Scene(room_with_charuco, loop)
SCENES["chessboard"] = Scene(room_with_chessboard, loop)
