"""Printed targets of known size, and where an image shows them: corners to a tenth of a pixel and without bias.

The user describes them: `apriltag-25h9:0.05`, `aruco-4x4:0.05`, `charuco-7x5:0.04:0.03`, `chessboard-7x5:0.04`.

OpenCV finds markers by a threshold, which moves the edges of blurred dark squares inward, and its subpixel corners keep
that: a marker looks 0.8 to 1.5 % too small. Its corners are only where the fit of the edges starts: the center of the
gradient across each side does not move, since blur is symmetric, and the sides meet in the corners. OpenCV's fit of
AprilTags has no such bias, but its corners are five times as far off, 0.3 px.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from torchslam.errors import MeasurementError
from torchslam.geometry import Camera
from torchslam.metric.source import parse_length

MIN_METERS, MAX_METERS = 0.001, 5.0
"""Sides of a marker: one that a camera resolves, and one that is believed; a larger number is meant in millimeters."""
MAX_SQUARES = 100
"""Most squares along a side of a board."""
ARUCO_COUNT = 250
"""Markers of a family aruco-NxN without a number: more of 4x4 would let other squares look like markers."""
SINGLE = r"(?P<family>apriltag-\w+|aruco-\w+(?:-\d+)?):(?P<size>[^:,]+)(?P<others>(?:,\d+=[^:,]+)*)"
BOARD = r"(?P<kind>charuco|chessboard)-(?P<columns>\d+)x(?P<rows>\d+):(?P<lengths>[^,]+)"
MAX_SHIFT_PX = 3.0
"""Largest distance between the corners by a threshold and those by the edges: else the edges are others."""
MIN_SIDE_PX = 12.0
"""Shortest side of a marker that counts, pixels: below, a tenth of a pixel is a percent of its size."""
FREE_SHARE = 0.75
"""Window in which a corner of a ChArUco board is refined, in widths of the white around its markers."""
REACH_PX = 3.5
"""Reach of a profile to either side of an edge, pixels. Of the first search's corners, the worst are 1.5 px off. From
2.5 to 5 nothing changes."""
REACH_CELLS = 0.4
"""... but at most this share of a marker's cell, and a pixel: beyond, the pattern begins. From .2 to .5 nothing
changes."""
STEP_PX = 0.25
"""Distance of the samples of a profile, pixels."""
ENDS = 0.08
"""Share of a side at either end that is left out: there the other side blurs into it. Tried from .05 to .15."""
MIN_PROFILES, MAX_PROFILES = 8, 64
"""Of a side, about one a pixel: the error of more is far below a tenth of a pixel."""
ROUNDS = 2
"""Of a fit around the corners of the round before. With one, squares are .1 % smaller, a third changes nothing."""
MIN_CONTRAST = 15.0
"""Least gray levels of 255 across an edge; the noise of a camera is 2 to 5."""
MAX_SPREAD_PX = 0.5
"""Largest root mean square of edge points around their line, pixels; .1 to .2 are usual."""
NEAR_PX = 0.1
"""Distance from the line within which an edge point always counts, pixels."""


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
    """Read the description of a target. Raises MeasurementError if it is none, or a size is impossible."""
    limits = f"--marker {text}", MIN_METERS, MAX_METERS
    if found := re.fullmatch(SINGLE, text):
        dictionary(found["family"], text)
        others = [other.split("=") for other in found["others"].split(",") if other]
        sizes = tuple((int(identity), parse_length(size, *limits)) for identity, size in others)
        twice = [identity for identity, _ in sizes if [other for other, _ in sizes].count(identity) > 1]
        if twice:
            raise MeasurementError(f"--marker {text}: marker {twice[0]} has two sizes")
        return Target(text, TargetKind.MARKER, found["family"], parse_length(found["size"], *limits), sizes)
    if found := re.fullmatch(BOARD, text):
        squares = int(found["columns"]), int(found["rows"])
        if not all(3 <= count <= MAX_SQUARES for count in squares):
            raise MeasurementError(
                f"--marker {text}: a board has 3 to {MAX_SQUARES} squares along each side; count all squares, "
                "not the corners between them"
            )
        lengths = [parse_length(length, *limits) for length in found["lengths"].split(":")]
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


def dictionary(family: str, text: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family of markers; `text` is the description that a message names.

    Raises MeasurementError if there is no such family.
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


@dataclass(frozen=True)
class Detection:
    """A target in an image: the id of a marker, 0 for a board, and its detected corners as rows of `Target.corners`."""

    identity: int
    rows: Int[np.ndarray, " C"]
    pixels: Float[np.ndarray, "C 2"]


class Detector(Protocol):
    """Finds the targets of one kind in images; another one may take the place of OpenCV's."""

    def detect(self, image: UInt8[np.ndarray, "H W"]) -> list[Detection]:
        """The targets in a gray image."""


class MarkerDetector:
    """Finds square markers of one family."""

    def __init__(self, family: str, text: str, camera: Camera) -> None:
        """Take the family, the description that messages name, and the camera, whose lens bends sides."""
        known = dictionary(family, text)
        self._cells, self._camera = known.markerSize + 2, camera
        self._detector = cv2.aruco.ArucoDetector(known, cv2.aruco.DetectorParameters())

    def detect(self, image: UInt8[np.ndarray, "H W"]) -> list[Detection]:
        """The markers in an image; those whose corners cannot be found exactly are left out."""
        found, ids, _ = self._detector.detectMarkers(image)
        if ids is None:
            return []
        quads = np.stack([quad[0] for quad in found]).astype(float)
        large = np.linalg.norm(sides(quads)[0], axis=-1).min(axis=-1) >= MIN_SIDE_PX
        quads, ids = quads[large], ids.ravel()[large]
        exact, right = fit_corners(image, quads, self._cells, side_bends(quads, self._camera))
        right &= np.abs(exact - quads).max(axis=(1, 2), initial=0.0) < MAX_SHIFT_PX
        return [
            Detection(int(identity), np.arange(4), corners)
            for identity, corners in zip(ids[right], exact[right], strict=True)
        ]


def side_bends(quads: Float[np.ndarray, "M 4 2"], camera: Camera) -> Float[np.ndarray, "M 4"] | None:
    """How far the lens bends the middle of each side of squares, pixels, as `fit_corners` takes it; None: nowhere."""
    if camera.model == "pinhole" or not len(quads):
        return None
    rays = camera.unproject(torch.from_numpy(quads).to(camera.params))
    middles, seen = camera.project(rays + rays.roll(-1, dims=1))
    along, normal = sides(quads)
    bends = ((middles.cpu().numpy() - quads - along / 2) * normal).sum(axis=-1)
    return np.where(seen.cpu().numpy(), bends, 0.0)


class ChessboardDetector:
    """Finds a plain chessboard, all of it in view."""

    def __init__(self, target: Target) -> None:
        """Take the board."""
        self._corners = target.squares[0] - 1, target.squares[1] - 1

    def detect(self, image: UInt8[np.ndarray, "H W"]) -> list[Detection]:
        """The board in an image, or nothing."""
        # The quick check of the other function costs a tenth where there is no board.
        if not cv2.checkChessboard(image, self._corners):
            return []
        found, pixels = cv2.findChessboardCornersSB(image, self._corners, flags=cv2.CALIB_CB_ACCURACY)
        if not found:
            return []
        return [Detection(0, np.arange(len(pixels)), pixels.reshape(-1, 2).astype(float))]


class CharucoDetector:
    """Finds a ChArUco board, also in part. Its family of markers is that of which most are found."""

    def __init__(self, target: Target) -> None:
        """Take the board."""
        self._target = target
        board = (target.squares, target.size, target.marker_size)
        self._boards = {
            family: cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard(*board, dictionary(family, target.text)))
            for family in ("aruco-4x4", "aruco-5x5", "aruco-6x6", "aruco-7x7", "apriltag-36h11")
        }
        self._seen = dict.fromkeys(self._boards, 0)

    def detect(self, image: UInt8[np.ndarray, "H W"]) -> list[Detection]:
        """The board in an image, or nothing. The family is settled by the first image that shows it."""
        settled = max(self._seen, key=lambda family: self._seen[family])
        families = [settled] if self._seen[settled] else list(self._boards)
        found = [(family, *self._boards[family].detectBoard(image)[:2]) for family in families]
        family, pixels, rows = max(found, key=lambda each: 0 if each[2] is None else len(each[2]))
        if rows is None or len(rows) < 4:
            return []
        self._seen[family] += len(rows)
        pixels, rows = pixels.reshape(-1, 2).astype(np.float32), rows.ravel().astype(int)
        # The side of a square in the image, by the distances of all corners from the first.
        corners = self._target.corners(0)[rows]
        apart, apart_px = (np.linalg.norm(each[1:] - each[0], axis=1) for each in (corners, pixels))
        side = float(np.median(apart_px / (apart / self._target.size)))
        free = (self._target.size - self._target.marker_size) / (2 * self._target.size)
        half = max(2, int(FREE_SHARE * free * side))
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
        pixels = cv2.cornerSubPix(image, pixels[:, None].copy(), (half, half), (-1, -1), stop).reshape(-1, 2)
        return [Detection(0, rows, pixels.astype(float))]


def detector_of(target: Target, camera: Camera) -> Detector:
    """OpenCV's detector of a target in the images of a camera."""
    if target.kind is TargetKind.MARKER:
        return MarkerDetector(target.family, target.text, camera)
    return ChessboardDetector(target) if target.kind is TargetKind.CHESSBOARD else CharucoDetector(target)


def fit_corners(
    image: UInt8[np.ndarray, "H W"],
    quads: Float[np.ndarray, "M 4 2"],
    cells: int,
    sagittas: Float[np.ndarray, "M 4"] | None = None,
) -> tuple[Float[np.ndarray, "M 4 2"], Bool[np.ndarray, " M"]]:
    """The corners of dark squares on a light ground.

    Args:
        image: gray.
        quads: the corners in order, to a pixel or two.
        cells: of a marker along a side, the border included.
        sagittas: how far the lens bends the middle of the side from each corner to the next, pixels, positive to the
            left of the direction to the next corner as the image shows it; None: nowhere.

    Returns:
        The corners in the same order, and which squares have them: not those with a side that is too weak, not
        straight, or out of the image.
    """
    bends = np.zeros(quads.shape[:2]) if sagittas is None else sagittas
    found = np.ones(len(quads), bool)
    for _ in range(ROUNDS if len(quads) else 0):
        intercepts, slopes, clear = _fit_sides(image, quads, cells, bends)
        found &= clear.all(axis=1)
        quads = np.where(found[:, None, None], _meet(quads, intercepts, slopes, bends), quads)
        found &= np.isfinite(quads).all(axis=(1, 2))
        quads = np.where(found[:, None, None], quads, 0.0)
    return quads, found


def sides(quads: Float[np.ndarray, "M 4 2"]) -> tuple[Float[np.ndarray, "M 4 2"], Float[np.ndarray, "M 4 2"]]:
    """Vectors from each corner to the next, and their unit normals to the left, as the image shows it."""
    along = np.roll(quads, -1, axis=1) - quads
    normal = np.stack((along[..., 1], -along[..., 0]), axis=-1)
    return along, normal / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)


def _fit_sides(
    image: UInt8[np.ndarray, "H W"],
    quads: Float[np.ndarray, "M 4 2"],
    cells: int,
    sagittas: Float[np.ndarray, "M 4"],
) -> tuple[Float[np.ndarray, "M 4"], Float[np.ndarray, "M 4"], Bool[np.ndarray, "M 4"]]:
    """Offset of each side along its normal at the first corner, its growth up to the second, and whether it is clear.

    The bend of the lens is on top of that.
    """
    along, normal = sides(quads)
    lengths = np.linalg.norm(along, axis=-1)
    middle = quads.mean(axis=1, keepdims=True)
    outward = np.sign(((quads + along / 2 - middle) * normal).sum(axis=-1))
    reach = min(REACH_PX, REACH_CELLS * float(lengths.min()) / cells + 1)
    offsets = np.arange(-reach, reach + STEP_PX / 2, STEP_PX)
    places = np.linspace(ENDS, 1 - ENDS, int(np.clip(lengths.max(), MIN_PROFILES, MAX_PROFILES)))
    bend = 4 * sagittas[..., None] * places * (1 - places)
    centers = quads[:, :, None] + places[:, None] * along[:, :, None] + bend[..., None] * normal[:, :, None]
    points = centers[..., None, :] + offsets[:, None] * normal[:, :, None, None]  # (M, 4, P, S, 2)
    height, width = image.shape
    is_inside = (points >= 0).all(axis=(2, 3, 4)) & (points <= (width - 1, height - 1)).all(axis=(2, 3, 4))
    x, y = points.astype(np.float32).reshape(-1, len(offsets), 2).transpose(2, 0, 1)
    # Gray levels between pixels; OpenCV rounds those of an image of whole numbers.
    left, top = np.floor((x.min(), y.min())).astype(int).clip(0)
    right, bottom = np.ceil((x.max(), y.max())).astype(int) + 2
    part = image[top:bottom, left:right].astype(np.float32)
    gray = cv2.remap(part, x - np.float32(left), y - np.float32(top), cv2.INTER_LINEAR).astype(float)
    rise = np.diff(outward[..., None, None] * gray.reshape(points.shape[:-1]), axis=-1).clip(0)
    total = rise.sum(axis=-1)
    contrast = np.median(total, axis=-1)
    shifts = (rise * (offsets[:-1] + STEP_PX / 2)).sum(axis=-1) / np.maximum(total, 1e-6)
    counts = total > 0.5 * contrast[..., None]
    for _ in range(2):  # the second time without what is far off
        intercepts, slopes = _lines(places, shifts, counts)
        residuals = np.abs(shifts - intercepts[..., None] - slopes[..., None] * places)
        usual = np.median(residuals, axis=-1)
        counts = counts & (residuals <= np.maximum(3 * usual, NEAR_PX)[..., None])
    count = counts.sum(axis=-1)
    spread = np.sqrt((counts * residuals**2).sum(axis=-1) / np.maximum(count, 1))
    clear = is_inside & (contrast >= MIN_CONTRAST) & (2 * count >= len(places)) & (spread <= MAX_SPREAD_PX)
    return intercepts, slopes, clear


def _lines(
    places: Float[np.ndarray, " P"], shifts: Float[np.ndarray, "M 4 P"], counts: Bool[np.ndarray, "M 4 P"]
) -> tuple[Float[np.ndarray, "M 4"], Float[np.ndarray, "M 4"]]:
    """Least squares of a line through the shifts that count: intercepts and slopes."""
    number = np.maximum(counts.sum(axis=-1), 1)
    mean_place = (counts * places).sum(axis=-1) / number
    mean_shift = (counts * shifts).sum(axis=-1) / number
    around = counts * (places - mean_place[..., None])
    slopes = (around * shifts).sum(axis=-1) / np.maximum((around * places).sum(axis=-1), 1e-9)
    return mean_shift - slopes * mean_place, slopes


def _meet(
    quads: Float[np.ndarray, "M 4 2"],
    intercepts: Float[np.ndarray, "M 4"],
    slopes: Float[np.ndarray, "M 4"],
    sagittas: Float[np.ndarray, "M 4"],
) -> Float[np.ndarray, "M 4 2"]:
    """Where each side, near its start, meets the one before, near its end: tangents of the bent sides there."""
    along, normal = sides(quads)
    # A bend 4 s t (1 - t) has the slope 4 s at the start and -4 s at the end.
    start = quads + intercepts[..., None] * normal
    leaving = along + (slopes + 4 * sagittas)[..., None] * normal
    end = quads + along + (intercepts + slopes)[..., None] * normal
    arriving = along + (slopes - 4 * sagittas)[..., None] * normal
    end, arriving = np.roll(end, 1, axis=1), np.roll(arriving, 1, axis=1)
    # start + a * leaving = end + b * arriving
    crossed = leaving[..., 0] * arriving[..., 1] - leaving[..., 1] * arriving[..., 0]
    apart = end - start
    share = apart[..., 0] * arriving[..., 1] - apart[..., 1] * arriving[..., 0]
    share /= np.where(crossed == 0, np.nan, crossed)
    return start + share[..., None] * leaving
