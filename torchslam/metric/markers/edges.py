"""Corners of dark squares, from their edges: where the gradient across each side has its center, and where sides meet.

A threshold moves the edges of a blurred dark square inward. The center of the gradient does not: blur is symmetric. All
squares of an image are fitted at once.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

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
