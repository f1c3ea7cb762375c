"""A renderer of textured rectangles for a pinhole camera: exact geometry, depth test per pixel, mip-mapping.

With a rectangle's axes and origin in camera coordinates as the columns of M, a point (u, v) of it is seen
along the ray r = M (u, v, 1) / z. So M^-1 r = (u, v, 1) / z: u/z, v/z and 1/z are linear in the pixel.
"""

from __future__ import annotations

import cv2
import numpy as np

from torchslam.data.synthetic.scene import MIP_LEVELS, Rectangle

NEAR = 0.05
"""Metres: what is nearer to the camera is not drawn."""
PADDING = 2
SHARPNESS = 0.7
"""Texels a pixel of the image may cover before the next coarser level is taken."""


class Renderer:
    """Renders one scene from any pose."""

    def __init__(self, rectangles: list[Rectangle], K: np.ndarray, size: tuple[int, int]) -> None:
        """K: (3, 3) pinhole matrix; size: (width, height) pixels."""
        self._K = K
        self._size = size
        self._origins = np.stack([rectangle.origin for rectangle in rectangles])
        self._axes_u = np.stack([rectangle.axis_u for rectangle in rectangles])
        self._axes_v = np.stack([rectangle.axis_v for rectangle in rectangles])
        self._sizes = np.array([rectangle.size for rectangle in rectangles])
        shapes = np.array([rectangle.texture.shape[::-1] for rectangle in rectangles])
        self._texels = (shapes / self._sizes).astype(np.float32)
        self._atlas, self._offsets = _pack([_pyramid(rectangle.texture) for rectangle in rectangles])

    def render(self, T_cw: np.ndarray) -> np.ndarray:
        """The image seen from T_cw (4, 4), (H, W) float32 in [0, 255]; black where no rectangle is hit."""
        forms = self._linear_forms(T_cw)
        winner = self._nearest(forms, T_cw)
        hit = winner >= 0
        winner[~hit] = 0
        width, height = self._size
        x = np.arange(width, dtype=np.float32)[None, :]
        y = np.arange(height, dtype=np.float32)[:, None]
        a = forms.astype(np.float32)[winner]  # (H, W, 3, 3)
        inverse_depth = a[..., 2, 0] * x + a[..., 2, 1] * y + a[..., 2, 2]
        depth = 1.0 / np.where(hit, inverse_depth, 1.0)
        texels = self._texels[winner]
        u = (a[..., 0, 0] * x + a[..., 0, 1] * y + a[..., 0, 2]) * depth
        v = (a[..., 1, 0] * x + a[..., 1, 1] * y + a[..., 1, 2]) * depth
        # How many texels the image moves by along either side of a pixel, from the derivatives of u and v.
        steps = [
            np.hypot(
                (a[..., 0, i] - u * a[..., 2, i]) * depth * texels[..., 0],
                (a[..., 1, i] - v * a[..., 2, i]) * depth * texels[..., 1],
            )
            for i in (0, 1)
        ]
        level = np.log2(SHARPNESS * np.maximum(*steps) + 1e-6).clip(0, MIP_LEVELS - 1.001)
        fine = level.astype(np.int64)
        u, v = u * texels[..., 0], v * texels[..., 1]
        blend = level - fine
        image = self._sample(winner, fine, u, v) * (1 - blend) + self._sample(winner, fine + 1, u, v) * blend
        return np.where(hit, image, 0.0).astype(np.float32)

    def _linear_forms(self, T_cw: np.ndarray) -> np.ndarray:
        """(R, 3, 3): per rectangle, (u, v, 1) / z in metres as linear forms of the pixel (x, y, 1)."""
        R, t = T_cw[:3, :3], T_cw[:3, 3]
        M = np.stack((self._axes_u @ R.T, self._axes_v @ R.T, self._origins @ R.T + t), axis=-1)
        # A rectangle seen exactly edge-on has no inverse and is invisible: forms of zero never win.
        edge_on = np.abs(np.linalg.det(M)) < 1e-9
        forms = np.linalg.inv(np.where(edge_on[:, None, None], np.eye(3), M)) @ np.linalg.inv(self._K)
        return np.where(edge_on[:, None, None], 0.0, forms)

    def _nearest(self, forms: np.ndarray, T_cw: np.ndarray) -> np.ndarray:
        """(H, W) int64: the rectangle seen at each pixel, -1 for none."""
        width, height = self._size
        best = np.zeros((height, width), np.float32)
        winner = np.full((height, width), -1, np.int64)
        for row, (form, size) in enumerate(zip(forms, self._sizes, strict=True)):
            bounds = self._bounds(row, T_cw)
            if bounds is None:
                continue
            x0, y0, x1, y1 = bounds
            x = np.arange(x0, x1)[None, :]
            y = np.arange(y0, y1)[:, None]
            u, v, inverse_depth = (
                (a * x).astype(np.float32) + (b * y + c).astype(np.float32) for a, b, c in form
            )
            window = np.s_[y0:y1, x0:x1]
            seen = (inverse_depth > best[window]) & (u >= 0) & (v >= 0)
            seen &= (u <= size[0] * inverse_depth) & (v <= size[1] * inverse_depth)
            np.copyto(best[window], inverse_depth, where=seen)
            winner[window][seen] = row
        return winner

    def _bounds(self, row: int, T_cw: np.ndarray) -> tuple[int, int, int, int] | None:
        """The pixels x0, y0, x1, y1 (end exclusive) a rectangle may cover; None where it is out of sight."""
        du, dv = self._sizes[row, 0] * self._axes_u[row], self._sizes[row, 1] * self._axes_v[row]
        corners = self._origins[row] + np.stack((np.zeros(3), du, du + dv, dv))
        corners = corners @ T_cw[:3, :3].T + T_cw[:3, 3]
        following = np.roll(corners, -1, axis=0)
        in_front = corners[:, 2] > NEAR
        crossing = in_front != (following[:, 2] > NEAR)
        run = np.where(crossing, following[:, 2] - corners[:, 2], 1.0)
        cut = corners + ((NEAR - corners[:, 2]) / run)[:, None] * (following - corners)
        outline = np.concatenate((corners[in_front], cut[crossing]))
        if len(outline) == 0:
            return None
        pixels = outline @ self._K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        x0, y0 = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
        x1, y1 = np.minimum(np.ceil(pixels.max(axis=0)) + 1, self._size).astype(int)
        return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None

    def _sample(self, winner: np.ndarray, level: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Bilinear lookup in the atlas at texel coordinates u, v (of level 0, from the texture's corner)."""
        offset = self._offsets[winner, level]
        shrink = np.exp2(-level.astype(np.float32))
        # The corner of the texture is half a texel before the centre of its first texel.
        x = u * shrink - 0.5 + offset[..., 0]
        y = v * shrink - 0.5 + offset[..., 1]
        return cv2.remap(self._atlas, x, y, cv2.INTER_LINEAR).astype(np.float32)


def _pyramid(texture: np.ndarray) -> list[np.ndarray]:
    """A texture at MIP_LEVELS sizes, each half of the one before."""
    levels = [texture]
    for _ in range(MIP_LEVELS - 1):
        rows, columns = levels[-1].shape
        levels.append(cv2.resize(levels[-1], (columns // 2, rows // 2), interpolation=cv2.INTER_AREA))
    return levels


def _pack(pyramids: list[list[np.ndarray]], width: int = 8192) -> tuple[np.ndarray, np.ndarray]:
    """All textures in one image, in rows, highest first, with repeated borders between them.

    Returns the atlas and offsets (textures, MIP_LEVELS, 2) float32: x, y of each first texel in it.
    """
    tiles = [(row, level) for row in range(len(pyramids)) for level in range(MIP_LEVELS)]
    tiles.sort(key=lambda tile: -pyramids[tile[0]][tile[1]].shape[0])
    places, offsets = [], np.zeros((len(pyramids), MIP_LEVELS, 2), np.float32)
    x = y = shelf = 0
    for row, level in tiles:
        padded = cv2.copyMakeBorder(
            pyramids[row][level], PADDING, PADDING, PADDING, PADDING, cv2.BORDER_REPLICATE
        )
        if x + padded.shape[1] > width:
            x, y, shelf = 0, y + shelf, 0
        places.append((x, y, padded))
        offsets[row, level] = (x + PADDING, y + PADDING)
        x, shelf = x + padded.shape[1], max(shelf, padded.shape[0])
    atlas = np.zeros((y + shelf, width), np.uint8)
    for x, y, padded in places:
        atlas[y : y + padded.shape[0], x : x + padded.shape[1]] = padded
    return atlas, offsets
