"""Where an image shows targets: corners of markers and boards, to a tenth of a pixel and without bias.

OpenCV finds markers by a threshold, which moves the edges of blurred dark squares inward, and its subpixel corners keep
that: a marker looks 0.8 to 1.5 % too small. Its corners are only where the fit of the edges starts: the center of the
gradient across each side does not move, since blur is symmetric, and the sides meet in the corners. OpenCV's fit of
AprilTags has no such bias, but its corners are five times as far off, 0.3 px.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from torchslam.geometry import Camera
from torchslam.metric.markers.targets import BOARD_FAMILIES, Target, TargetKind, dictionary

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
MAX_PROFILES = 64
"""Most profiles of a side, about one a pixel: the error of longer ones is far below a tenth of a pixel."""
MIN_PROFILES = 8
"""Least profiles of a side."""
ROUNDS = 2
"""Of a fit around the corners of the round before. With one, squares are .1 % smaller, a third changes nothing."""
MIN_CONTRAST = 15.0
"""Least gray levels of 255 across an edge; the noise of a camera is 2 to 5."""
MAX_SPREAD_PX = 0.5
"""Largest root mean square of edge points around their line, pixels; .1 to .2 are usual."""
NEAR_PX = 0.1
"""Distance from the line within which an edge point always counts, pixels."""


@dataclass(frozen=True)
class Detection:
    """A target in an image.

    Attributes:
        identity: id of a marker; 0 for a board.
        rows: of the detected corners, in `Target.corners`.
        pixels: where they are.
    """

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
        self._boards = {family: self._board(family) for family in BOARD_FAMILIES}
        self._seen = dict.fromkeys(self._boards, 0)

    def _board(self, family: str) -> cv2.aruco.CharucoDetector:
        target = self._target
        board = cv2.aruco.CharucoBoard(
            target.squares, target.size, target.marker_size, dictionary(family, target.text)
        )
        return cv2.aruco.CharucoDetector(board)

    def detect(self, image: UInt8[np.ndarray, "H W"]) -> list[Detection]:
        """The board in an image, or nothing. The family is settled by the first image that shows it."""
        settled = max(self._seen, key=lambda family: self._seen[family])
        families = [settled] if self._seen[settled] else list(self._boards)
        found = {family: self._boards[family].detectBoard(image)[:2] for family in families}
        family, (pixels, rows) = max(
            found.items(), key=lambda item: 0 if item[1][1] is None else len(item[1][1])
        )
        if rows is None or len(rows) < 4:
            return []
        self._seen[family] += len(rows)
        pixels, rows = pixels.reshape(-1, 2).astype(np.float32), rows.ravel().astype(int)
        side = _side_px(pixels, self._target.corners(0)[rows], self._target.size)
        free = (self._target.size - self._target.marker_size) / (2 * self._target.size)
        half = max(2, int(FREE_SHARE * free * side))
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
        pixels = cv2.cornerSubPix(image, pixels[:, None].copy(), (half, half), (-1, -1), stop).reshape(-1, 2)
        return [Detection(0, rows, pixels.astype(float))]


def _side_px(pixels: Float[np.ndarray, "C 2"], corners: Float[np.ndarray, "C 2"], size: float) -> float:
    """Length of a square of a board in the image, pixels, by the distances of all corners from the first."""
    lengths = np.linalg.norm(corners[1:] - corners[0], axis=1) / size
    return float(np.median(np.linalg.norm(pixels[1:] - pixels[0], axis=1) / lengths))


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


def sides(
    quads: Float[np.ndarray, "M 4 2"],
) -> tuple[Float[np.ndarray, "M 4 2"], Float[np.ndarray, "M 4 2"]]:
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
    rise = np.diff(outward[..., None, None] * _sampled(image, x, y).reshape(points.shape[:-1]), axis=-1).clip(
        0
    )
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


def _sampled(
    image: UInt8[np.ndarray, "H W"], x: Float[np.ndarray, "N S"], y: Float[np.ndarray, "N S"]
) -> Float[np.ndarray, "N S"]:
    """Gray levels between pixels; OpenCV rounds those of an image of whole numbers."""
    low, high = (
        np.floor((x.min(), y.min())).astype(int).clip(0),
        np.ceil((x.max(), y.max())).astype(int) + 1,
    )
    part = image[low[1] : high[1] + 1, low[0] : high[0] + 1].astype(np.float32)
    return cv2.remap(part, x - np.float32(low[0]), y - np.float32(low[1]), cv2.INTER_LINEAR).astype(float)


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
    share = (apart[..., 0] * arriving[..., 1] - apart[..., 1] * arriving[..., 0]) / np.where(
        crossed == 0, np.nan, crossed
    )
    return start + share[..., None] * leaving
