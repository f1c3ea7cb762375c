"""A video file, decoded in order; going back decodes from the start again."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.data.calibration import Calibration, fit_camera
from torchslam.data.folder import DEFAULT_RATE
from torchslam.data.image_file import bgr_to_tensor, grey_to_tensor
from torchslam.data.sequence import Sequence
from torchslam.errors import CalibrationError, FrameError, SequenceError
from torchslam.geometry.camera import Camera

SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v"})


class VideoSequence(Sequence):
    """Frames of a video at its nominal rate (or `rate`); their number is what the container says."""

    def __init__(self, path: Path, camera: Camera | Calibration | None, rate: float | None = None) -> None:
        """Raises SequenceError for a file that holds no video, CalibrationError without a fitting camera."""
        if camera is None:
            raise CalibrationError(
                f"{path}: a video says nothing about its camera; "
                "give it with --camera fx,fy,cx,cy[,k1,k2,p1,p2,k3] or as a calibration file"
            )
        self._path = path
        self._capture = cv2.VideoCapture(str(path))
        self._position = 0
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        first = self._read(0) if self._capture.isOpened() and count > 0 else None
        if first is None:
            raise SequenceError(f"{path}: cannot be read as a video")
        size = (first.shape[1], first.shape[0])
        camera = fit_camera(camera, size, str(path))
        rate = rate or self._capture.get(cv2.CAP_PROP_FPS) or DEFAULT_RATE
        super().__init__(path.stem, "video", camera, torch.arange(count, dtype=torch.float64) / rate)

    def image(self, index: int) -> Tensor:
        return grey_to_tensor(cv2.cvtColor(self._frame(index), cv2.COLOR_BGR2GRAY))

    def colour(self, index: int) -> Tensor:
        return bgr_to_tensor(self._frame(index))

    def image_name(self, index: int) -> str:
        return f"{self._path}#{index}"

    def _frame(self, index: int) -> np.ndarray:
        frame = self._read(index)
        if frame is None:
            raise FrameError(f"{self.image_name(index)}: cannot be decoded, or the video ends before it")
        return frame

    def _read(self, index: int) -> np.ndarray | None:
        """The (H, W, 3) uint8 frame `index`, blue first; frames in between are skipped without conversion."""
        if index < self._position:
            self._capture.release()
            self._capture.open(str(self._path))
            self._position = 0
        while self._position < index:
            if not self._capture.grab():
                return None
            self._position += 1
        self._position += 1
        decoded, frame = self._capture.read()
        return frame if decoded else None
