"""What pages and examples find where they are run: a folder with a short video, and a webcam that shows it."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import torchslam


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 frames of the rendered room, 320x240, 15 a second."""
    path = tmp_path_factory.mktemp("video") / "video.mp4"
    sequence = torchslam.open_sequence("synthetic:room", resize_to="320x240", stride=2, limit=40)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 15, sequence.size)
    for index in range(len(sequence)):
        writer.write(np.ascontiguousarray(sequence.color(index).numpy()[..., ::-1]))
    writer.release()
    return path


@pytest.fixture
def folder(tmp_path: Path, video: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a page begins."""
    shutil.copy(video, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    opened = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: opened(str(video) if source == 0 else source))
    return tmp_path
