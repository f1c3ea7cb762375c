"""Printed targets of known size, as the user describes them.

`apriltag-25h9:0.05`, `aruco-4x4:0.05`, `charuco-7x5:0.04:0.03`, `chessboard-7x5:0.04`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Float

from torchslam.errors import MeasurementError

MAX_METERS = 100.0
"""Longest side of a marker that is believed; a larger number is meant in millimeters."""
MIN_METERS = 0.001
"""Shortest side of a marker that a camera resolves."""
MAX_SQUARES = 100
"""Most squares along a side of a board."""
ARUCO_COUNT = 250
"""Markers of a family aruco-NxN without a number: more of 4x4 would let other squares look like markers."""

SINGLE = re.compile(
    r"(?P<family>apriltag-\w+|aruco-\w+(?:-\d+)?):(?P<size>[^:,]+)(?P<others>(?:,\d+=[^:,]+)*)"
)
BOARD = re.compile(r"(?P<kind>charuco|chessboard)-(?P<columns>\d+)x(?P<rows>\d+):(?P<lengths>[^,]+)")
BOARD_FAMILIES = ("aruco-4x4", "aruco-5x5", "aruco-6x6", "aruco-7x7", "apriltag-36h11")
"""Families of the markers in a ChArUco board, of which its description does not say the one."""


class TargetKind(StrEnum):
    """Kind of a target."""

    MARKER = "marker"
    """Square markers with an id each."""
    CHARUCO = "charuco"
    """A chessboard with markers in its white squares."""
    CHESSBOARD = "chessboard"
    """A plain chessboard."""


@dataclass(frozen=True)
class Target:
    """A kind of target, as the user describes it.

    Attributes:
        text: the description.
        kind: what it is.
        family: of the markers, such as "apriltag-25h9"; empty for boards.
        size: meters: side of the black square of a marker, or of a square of a board.
        others: sizes of the markers with other ones, by id.
        squares: columns and rows of a board.
        marker_size: meters: side of the markers in a ChArUco board.
    """

    text: str
    kind: TargetKind
    family: str
    size: float
    others: tuple[tuple[int, float], ...] = ()
    squares: tuple[int, int] = (0, 0)
    marker_size: float = 0.0

    def corners(self, identity: int) -> Float[np.ndarray, "C 2"]:
        """Positions of the corners of a target in its plane, meters; those of a marker in OpenCV's order."""
        if self.kind is TargetKind.MARKER:
            size = dict(self.others).get(identity, self.size)
            return size * np.array(((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)))
        columns, rows = self.squares[0] - 1, self.squares[1] - 1
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        return self.size * np.stack((x, y), axis=-1).reshape(-1, 2).astype(float)

    def name(self, identity: int) -> str:
        """A target in words."""
        return f"{self.family} {identity}" if self.kind is TargetKind.MARKER else str(self.kind)


def parse_target(text: str) -> Target:
    """Read the description of a target.

    Raises:
        MeasurementError: it is none, or a size is impossible.
    """
    if found := SINGLE.fullmatch(text):
        dictionary(found["family"], text)
        others = [other.split("=") for other in found["others"].split(",") if other]
        sizes = tuple((int(identity), _length(size, text)) for identity, size in others)
        twice = [identity for identity, _ in sizes if [other for other, _ in sizes].count(identity) > 1]
        if twice:
            raise MeasurementError(f"--marker {text}: marker {twice[0]} has two sizes")
        return Target(text, TargetKind.MARKER, found["family"], _length(found["size"], text), sizes)
    if found := BOARD.fullmatch(text):
        squares = int(found["columns"]), int(found["rows"])
        if not all(3 <= count <= MAX_SQUARES for count in squares):
            raise MeasurementError(
                f"--marker {text}: a board has 3 to {MAX_SQUARES} squares along each side; count all squares, "
                "not the corners between them"
            )
        lengths = [_length(length, text) for length in found["lengths"].split(":")]
        kind = TargetKind(found["kind"])
        if len(lengths) != (2 if kind is TargetKind.CHARUCO else 1):
            needed = "of a square and of a marker" if kind is TargetKind.CHARUCO else "of a square"
            raise MeasurementError(f"--marker {text}: {kind} needs the side {needed}, in meters")
        if kind is TargetKind.CHARUCO and lengths[1] >= lengths[0]:
            raise MeasurementError(
                f"--marker {text}: a marker must be smaller than the square that it lies in"
            )
        return Target(text, kind, "", lengths[0], (), squares, lengths[-1] if len(lengths) > 1 else 0.0)
    raise MeasurementError(
        f"--marker {text}: write FAMILY:METERS, such as apriltag-36h11:0.05 or aruco-4x4:0.05, with other sizes of "
        "ids as apriltag-36h11:0.05,7=0.1; or charuco-7x5:SQUARE:MARKER or chessboard-7x5:SQUARE, with columns and "
        "rows of squares"
    )


def _length(text: str, whole: str) -> float:
    """A size in meters."""
    try:
        length = float(text)
    except ValueError:
        raise MeasurementError(f"--marker {whole}: {text!r} is no length in meters") from None
    if not MIN_METERS <= length <= MAX_METERS:
        raise MeasurementError(
            f"--marker {whole}: a side of {text} m; sizes are in meters, from {MIN_METERS} to {MAX_METERS:g}"
        )
    return length


def dictionary(family: str, text: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family of markers; `text` is the description that a message names.

    Raises:
        MeasurementError: there is no such family.
    """
    kind, _, rest = family.partition("-")
    name = f"DICT_APRILTAG_{rest.lower()}" if kind == "apriltag" else f"DICT_{rest.upper().replace('-', '_')}"
    if kind == "aruco" and rest.lower() == "original":
        name = "DICT_ARUCO_ORIGINAL"
    elif kind == "aruco" and rest.count("-") == 0:
        name += f"_{ARUCO_COUNT}"
    if not hasattr(cv2.aruco, name):
        known = [each for each in dir(cv2.aruco) if re.fullmatch(r"DICT_APRILTAG_\d+h\d+", each)]
        tags = ", ".join(each.removeprefix("DICT_APRILTAG_") for each in known)
        raise MeasurementError(
            f"--marker {text}: no family {family}; there are apriltag-({tags}), aruco-(4x4, 5x5, 6x6, 7x7) with 50, "
            f"100, 250 or 1000 markers (aruco-4x4-1000, else {ARUCO_COUNT}), and aruco-original"
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
