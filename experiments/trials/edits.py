"""Faults of images: functions that make deterministic edits, see `edited.Edit`."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from experiments.trials.edited import Edit
from torchslam.geometry import Camera, so3_exp

WHITE = 255
EXPOSURE_FRAMES, EXPOSURE = 40, 0.25  # duration of an exposure, and the light in every second one
CAPTION = "CAM 01 2026-11-21 REC"
LOGO_CELLS, LOGO_SEED = (12, 20), 5  # rows and columns of the random squares
LOGO_AT, LOGO_SIZE = 8, (64, 32)  # pixels from the upper left corner; width and height
BLUR_TURN_DEG = 13  # from frame to frame
WAVE_FRAMES = 9  # in which the shear of a rolling shutter comes back
CORNER_LIGHT = 0.1  # share that is left of it in the corners, as with a cheap wide lens
SPOTS, SPOT_SEED, SPOT_SIGMA, SPOT_GRAY = 40, 3, 6, 60


def black(gray: np.ndarray, _: int) -> np.ndarray:
    """A black image."""
    return np.zeros_like(gray)


def exposure_step(gray: np.ndarray, frame: int) -> np.ndarray:
    """Every second stretch of frames has a quarter of the light."""
    gain = EXPOSURE if (frame // EXPOSURE_FRAMES) % 2 else 1.0
    return (gain * gray).astype(np.uint8)


def brighter(gain: float) -> Edit:
    """Overexposure: the light times a gain, saturated at white."""

    def edit(gray: np.ndarray, _: int) -> np.ndarray:
        return np.rint(gain * gray.astype(np.float64)).clip(0, WHITE).astype(np.uint8)

    return edit


def noise(sigma: float) -> Edit:
    """Gaussian noise, different in every frame."""

    def edit(gray: np.ndarray, frame: int) -> np.ndarray:
        added = gray + np.random.default_rng(frame).normal(0, sigma, gray.shape)
        return added.clip(0, WHITE).astype(np.uint8)

    return edit


def pale(contrast: float) -> Edit:
    """Fog, or a bad lens: reduced contrast around middle gray, and noise of one gray value."""
    noisy, middle = noise(1.0), WHITE / 2

    def edit(gray: np.ndarray, frame: int) -> np.ndarray:
        return noisy(np.rint(middle + contrast * (gray - middle)).astype(np.uint8), frame)

    return edit


def jpeg(quality: int) -> Edit:
    def edit(gray: np.ndarray, _: int) -> np.ndarray:
        _, data = cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, quality])
        decoded = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        assert decoded is not None
        return decoded

    return edit


def motion_blur(length: int) -> Edit:
    """Motion blur along a line whose direction rotates from frame to frame."""
    line = np.zeros((length, length), np.float32)
    line[length // 2] = 1 / length
    middle = (length - 1) / 2

    def edit(gray: np.ndarray, frame: int) -> np.ndarray:
        turn = cv2.getRotationMatrix2D((middle, middle), BLUR_TURN_DEG * frame % 180, 1)
        kernel = cv2.warpAffine(line, turn, (length, length))
        return cv2.filter2D(gray, -1, kernel / kernel.sum())

    return edit


def rolling(amplitude: float) -> Edit:
    """Rolling shutter of a shaking camera: rows are shifted sideways by a sine."""

    def edit(gray: np.ndarray, frame: int) -> np.ndarray:
        height, width = gray.shape
        x, y = _grid(width, height)
        x += amplitude * np.sin(2 * np.pi * (y / height + frame / WAVE_FRAMES), dtype=np.float32)
        return cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    return edit


def overlay(size: tuple[int, int]) -> Edit:
    """A recorder overlay for images of (width, height): a large logo and a caption with a shadow."""
    width, height = size
    mark = logo((width // 4, height // 8))

    def edit(gray: np.ndarray, _: int) -> np.ndarray:
        marked = _put(gray, mark, 10)
        for color, y, thickness in ((WHITE, 40, 2), (0, 41, 1)):
            cv2.putText(marked, CAPTION, (width // 2, y), cv2.FONT_HERSHEY_SIMPLEX, 0.9, color, thickness)
        return marked

    return edit


def small_logo() -> Edit:
    mark = logo(LOGO_SIZE)
    return lambda gray, _: _put(gray, mark, LOGO_AT)


def logo(size: tuple[int, int]) -> np.ndarray:
    """Random squares with sharp edges, (height, width) of size (width, height): full of corners."""
    cells = WHITE * np.random.default_rng(LOGO_SEED).random(LOGO_CELLS)
    return cv2.resize(cells.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)


def occluder(texture: np.ndarray, share: float, speed: int) -> Edit:
    """A strip of another image, `share` of it wide, moves to the right by `speed` pixels a frame, again and again.

    texture: (H, W) of the size of the images
    """
    width = texture.shape[1]
    wide = int(share * width)

    def edit(gray: np.ndarray, frame: int) -> np.ndarray:
        left = speed * frame % (width + wide) - wide
        start, stop = max(left, 0), min(left + wide, width)
        covered = gray.copy()
        covered[:, start:stop] = texture[:, start - left : stop - left]
        return covered

    return edit


def lens_dirt(size: tuple[int, int]) -> Edit:
    """Soft static gray spots, for images of (width, height)."""
    width, height = size
    rng = np.random.default_rng(SPOT_SEED)
    cover: np.ndarray = np.zeros((height, width), np.float32)
    for _ in range(SPOTS):
        place = int(rng.integers(width)), int(rng.integers(height))
        cv2.circle(cover, place, int(rng.integers(5, 40)), float(rng.uniform(0.3, 0.9)), cv2.FILLED)
    cover = cv2.GaussianBlur(cover, (0, 0), SPOT_SIGMA)
    return lambda gray, _: (gray * (1 - cover) + SPOT_GRAY * cover).astype(np.uint8)


def vignette(gray: np.ndarray, _: int) -> np.ndarray:
    """Light falls off with the square of the distance from the middle, to little in the corners."""
    height, width = gray.shape
    x, y = _grid(width, height)
    from_middle = np.hypot(x - width / 2, y - height / 2) / np.hypot(width / 2, height / 2)
    return np.rint(gray * (1 - (1 - CORNER_LIGHT) * from_middle**2)).astype(np.uint8)


def turned(camera: Camera, angle: float) -> Edit:
    """The view of a camera that has turned by `angle`, radians, about its y axis: its T_cw is R_y(angle) T_cw.

    Pixels from outside of the image are black.
    """

    def edit(gray: np.ndarray, _: int) -> np.ndarray:
        height, width = gray.shape
        pixels = torch.from_numpy(np.stack(_grid(width, height), -1)).reshape(-1, 2).to(camera.params)
        R = so3_exp(pixels.new_tensor((0.0, angle, 0.0)))
        sources, seen = camera.project(camera.unproject(pixels) @ R)
        outside = -float(width)
        sources = torch.where(seen[:, None], sources, outside).reshape(height, width, 2)
        x, y = (part.contiguous().numpy() for part in sources.to(torch.float32).unbind(-1))
        return cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)

    return edit


def _grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """(height, width) float32 columns and rows of all pixels."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return x.copy(), y.copy()


def _put(gray: np.ndarray, mark: np.ndarray, corner: int) -> np.ndarray:
    marked = gray.copy()
    marked[corner : corner + mark.shape[0], corner : corner + mark.shape[1]] = mark
    return marked
