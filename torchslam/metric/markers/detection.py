"""Where an image shows targets: corners of markers and boards, to a tenth of a pixel and without bias.

OpenCV finds markers by a threshold, which moves the edges of black squares inward, and its subpixel corners keep that:
a marker looks 0.8 to 1.5 % too small. Its corners are only where the fit of the edges starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from torchslam.geometry import Camera
from torchslam.metric.markers.edges import fit_corners, sides
from torchslam.metric.markers.targets import BOARD_FAMILIES, Target, TargetKind, dictionary

MAX_SHIFT_PX = 3.0
"""Largest distance between the corners by a threshold and those by the edges: else the edges are others."""
MIN_SIDE_PX = 12.0
"""Shortest side of a marker that counts, pixels: below, a tenth of a pixel is a percent of its size."""
FREE_SHARE = 0.75
"""Window in which a corner of a ChArUco board is refined, in widths of the white around its markers."""


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
