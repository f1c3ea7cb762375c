"""A renderer of textured rectangles for a pinhole camera: exact geometry, depth test per pixel, mip-mapping.

With a rectangle's axes and origin in camera coordinates as the columns of M, a point (u, v) of it is seen
along the ray r = M (u, v, 1) / z. So M^-1 r = (u, v, 1) / z: u/z, v/z and 1/z are linear in the pixel.
"""

from __future__ import annotations

import cv2
import numpy as np

from torchslam.data.synthetic.scene import MIP_LEVELS, Rectangle

NEAR = 0.05  # meters: what is nearer to the camera is not drawn
ROWS_OF_BOUNDS = 9
"""Rows whose poses bound where a rectangle may be seen, of an image with a pose for each row. Between them the camera
moves by less than a pixel. Tried at this value only."""
PADDING = 2  # texels that repeat the border of a texture, so that interpolation does not reach the next one
SHARPNESS = 0.7  # choice of the mip level: 1 takes one texel per pixel; less is sharper, with some aliasing


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
        du, dv = self._sizes[:, :1] * self._axes_u, self._sizes[:, 1:] * self._axes_v
        self._corners = np.stack((np.zeros_like(du), du, du + dv, dv), axis=1) + self._origins[:, None]
        shapes = np.array([rectangle.texture.shape[::-1] for rectangle in rectangles])
        self._texels = shapes / self._sizes  # per meter
        textures = {id(rectangle.texture): rectangle.texture for rectangle in rectangles}  # each once
        self._atlas, offsets = _pack([_pyramid(texture) for texture in textures.values()])
        places = {key: place for place, key in enumerate(textures)}
        offsets = offsets[[places[id(rectangle.texture)] for rectangle in rectangles]]
        # Per rectangle and level: what a texel shrinks to and where the corner of the first one lies in the atlas, half
        # a texel before its center.
        shrink = np.tile(np.exp2(-np.arange(MIP_LEVELS)), len(rectangles))
        self._tiles = np.stack((shrink, *(offsets.reshape(-1, 2) - 0.5).T)).astype(np.float32)

    def render(self, T_cw: np.ndarray) -> np.ndarray:
        """The image seen from T_cw, (H, W) float32 in [0, 255]; black where no rectangle is hit.

        T_cw is (4, 4), or (H, 4, 4): a pose for each row, as of a rolling shutter.
        """
        T_cw = T_cw.reshape(-1, 4, 4)
        forms = self._linear_forms(T_cw)
        some = np.linspace(0, len(T_cw) - 1, ROWS_OF_BOUNDS).round().astype(int)
        bounds = np.stack([self._bounds(pose) for pose in T_cw[some if len(T_cw) > 1 else [0]]])
        bounds = np.concatenate((bounds[..., :2].min(0), bounds[..., 2:].max(0)), axis=1)
        winner = self._nearest(forms, bounds)
        hit = winner >= 0
        winner[~hit] = 0
        x = np.arange(self._size[0], dtype=np.float32)[None, :]
        y = np.arange(self._size[1], dtype=np.float32)[:, None]
        # Of each pixel's rectangle: (u, v, 1) / z in texels as a x + b y + c.
        texels = np.append(self._texels, np.ones((forms.shape[1], 1)), axis=1)
        row = np.zeros_like(winner) if len(forms) == 1 else np.arange(len(forms))[:, None]
        a, b, c = (
            np.moveaxis((texels * forms[..., i]).astype(np.float32)[row, winner], -1, 0) for i in range(3)
        )
        u, v, inverse_depth = a * x + b * y + c
        depth = 1.0 / np.where(hit, inverse_depth, 1.0)
        u *= depth
        v *= depth
        # How many texels the texture moves by from a pixel to the next one, from the derivatives of u and v.
        steps = [
            depth * depth * ((slope[0] - u * slope[2]) ** 2 + (slope[1] - v * slope[2]) ** 2)
            for slope in (a, b)
        ]
        level = 0.5 * np.log2(SHARPNESS**2 * np.maximum(*steps) + 1e-12)
        level = level.clip(0, MIP_LEVELS - 1.001)
        fine = level.astype(np.int64)
        blend = level - fine
        tile = winner * MIP_LEVELS + fine
        image = self._sample(tile, u, v) * (1 - blend) + self._sample(tile + 1, u, v) * blend
        return np.where(hit, image, 0.0).astype(np.float32)

    def _linear_forms(self, T_cw: np.ndarray) -> np.ndarray:
        """Return (N, R, 3, 3): (u, v, 1) / z of each rectangle, in meters, as linear forms of the pixel (x, y, 1).

        T_cw: (N, 4, 4)
        """
        R_wc, t = T_cw[:, :3, :3].transpose(0, 2, 1), T_cw[:, None, :3, 3]
        M = np.stack((self._axes_u @ R_wc, self._axes_v @ R_wc, self._origins @ R_wc + t), axis=-1)
        # A rectangle seen exactly edge-on has no inverse and is invisible: forms of zero never win.
        edge_on = np.abs(np.linalg.det(M))[..., None, None] < 1e-9
        forms = np.linalg.inv(np.where(edge_on, np.eye(3), M)) @ np.linalg.inv(self._K)
        return np.where(edge_on, 0.0, forms)

    def _nearest(self, forms: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        """Return (H, W) int64: the rectangle seen at each pixel, -1 for none; forms (1, R, 3, 3) or (H, R, 3, 3)."""
        best = np.zeros(self._size[::-1], np.float32)
        winner = np.full(self._size[::-1], -1, np.int64)
        for row, (x0, y0, x1, y1) in enumerate(bounds.tolist()):
            if x0 >= x1 or y0 >= y1:
                continue
            x = np.arange(x0, x1)[None, :]
            y = np.arange(y0, y1)[:, None]
            seen_by = forms[:, row] if len(forms) == 1 else forms[y0:y1, row]
            u, v, inverse_depth = (
                (a * x).astype(np.float32) + (b * y + c).astype(np.float32)
                for a, b, c in seen_by.transpose(1, 2, 0)[..., None]
            )
            width, height = self._sizes[row].astype(np.float32)
            window = np.s_[y0:y1, x0:x1]
            seen = (inverse_depth > best[window]) & (u >= 0) & (v >= 0)
            seen &= (u <= width * inverse_depth) & (v <= height * inverse_depth)
            np.copyto(best[window], inverse_depth, where=seen)
            np.copyto(winner[window], row, where=seen)
        return winner

    def _bounds(self, T_cw: np.ndarray) -> np.ndarray:
        """Return (R, 4) int64: the pixels x0, y0, x1, y1 (end exclusive) that each rectangle may cover."""
        corners = self._corners @ T_cw[:3, :3].T + T_cw[:3, 3]
        following = np.roll(corners, -1, axis=1)
        z, z_following = corners[..., 2:], following[..., 2:]
        in_front = z > NEAR
        # Where a side crosses the near plane it is cut there: the outline is the corners in front and the cuts.
        is_cut = in_front != (z_following > NEAR)
        cuts = corners + (NEAR - z) / np.where(is_cut, z_following - z, 1.0) * (following - corners)
        outline = np.concatenate((corners, cuts), axis=1)
        exists = np.concatenate((in_front, is_cut), axis=1)
        pixels = np.where(exists, outline, (0.0, 0.0, 1.0)) @ self._K.T
        pixels = pixels[..., :2] / pixels[..., 2:]
        start = np.floor(np.where(exists, pixels, np.inf).min(axis=1)).clip(0, self._size)
        end = np.ceil(np.where(exists, pixels, -np.inf).max(axis=1) + 1).clip(0, self._size)
        return np.concatenate((start, end), axis=1).astype(np.int64)

    def _sample(self, tile: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Bilinear lookup of the atlas, (H, W), at texels u, v of level 0 from the corner of a row of `_tiles`."""
        shrink, x, y = (column[tile] for column in self._tiles)
        return cv2.remap(self._atlas, u * shrink + x, v * shrink + y, cv2.INTER_LINEAR).astype(np.float32)


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
