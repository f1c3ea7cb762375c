"""The images of exported frames, from the sequence that a run read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from torchslam.data import open_sequence
from torchslam.data.opening import RENDERED
from torchslam.data.sequence import Sequence
from torchslam.errors import ResultsError, SequenceError
from torchslam.export.scene import Scene
from torchslam.export.undistortion import Undistorter
from torchslam.geometry import Camera

WITHOUT = "--sequence says where it is now, --no-images does without"


class Images:
    """Colour images by frame, without distortion where that is asked for."""

    def __init__(self, sequence: Sequence, camera: Camera, undistort: bool = False) -> None:
        self._sequence = sequence
        self._undistort = Undistorter(camera) if undistort and camera.model != "pinhole" else None

    def bgr(self, frame_id: int) -> np.ndarray:
        """(H, W, 3) uint8 as OpenCV writes it: blue first. Raises FrameError where it cannot be read."""
        image = cv2.cvtColor(self._sequence.colour(frame_id).contiguous().numpy(), cv2.COLOR_RGB2BGR)
        return image if self._undistort is None else self._undistort(image)


def open_images(source: str, scene: Scene) -> Sequence:
    """The sequence that the frames of a scene are from.

    Raises ResultsError where it is gone or another one, by its frames' times.
    """
    try:
        sequence = open_sequence(source, None if source.startswith(RENDERED) else scene.camera)
    except SequenceError as error:
        raise ResultsError(f"the sequence of this run cannot be read: {error}; {WITHOUT}") from None
    ids = scene.frame_ids
    if int(ids.max()) >= len(sequence) or not torch.equal(sequence.timestamps[ids], scene.timestamps):
        raise ResultsError(
            f"{source}: not the sequence of this run, whose frames have other times; {WITHOUT}"
        )
    return sequence


def write_images(folder: Path, scene: Scene, images: Images) -> None:
    """Write the image of every frame as PNG, under its name; images of another export are removed."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("[0-9]" * 6 + ".png"):
        old.unlink()
    for frame_id, name in zip(scene.frame_ids.tolist(), scene.image_names, strict=True):
        if not cv2.imwrite(str(folder / name), images.bgr(frame_id)):
            raise ResultsError(f"{folder / name}: cannot be written")
