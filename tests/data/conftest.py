"""Small sequences on disk, in the layouts that the readers know."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

SIZE = (64, 48)


@pytest.fixture
def write_picture() -> Callable[..., np.ndarray]:
    """Writes an image with content of its own per seed; returns its (H, W) uint8 pixels."""

    def write(path: Path, seed: int = 0, size: tuple[int, int] = SIZE) -> np.ndarray:
        path.parent.mkdir(parents=True, exist_ok=True)
        noise = np.random.default_rng(seed).integers(0, 256, size[::-1], dtype=np.uint8)
        image = cv2.GaussianBlur(noise, (0, 0), 1.0)
        assert cv2.imwrite(str(path), image)
        return image

    return write


@pytest.fixture
def tum_folder(tmp_path: Path, write_picture: Callable[..., np.ndarray]) -> Callable[..., Path]:
    """Writes five frames at 10 Hz, ground truth at 20 Hz and a calibration, in the layout of ETH3D and TUM."""

    def write(suffix: str = ".png", calibration: str | None = "60 61 31.5 23.5\n") -> Path:
        folder = tmp_path / "sequence"
        for index in range(5):
            write_picture(folder / "rgb" / f"{index}{suffix}", index)
        frames = [f"{1000 + index / 10:.6f} rgb/{index}{suffix}\n" for index in range(5)]
        (folder / "rgb.txt").write_text("# color images\n# timestamp filename\n" + "".join(frames))
        poses = [f"{1000 + index / 20:.6f} {index / 20} 0 0 0 0 0 1\n" for index in range(7)]
        (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(poses))
        if calibration is not None:
            (folder / "calibration.txt").write_text(calibration)
        return folder

    return write
