"""The images of exported frames, from the sequence that a run read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from torchslam.data import open_sequence
from torchslam.data.formats.transforms import resize
from torchslam.data.sequence import Sequence
from torchslam.errors import ResultsError, SequenceError
from torchslam.geometry import Camera
from torchslam.io.export.scene import Scene
from torchslam.io.export.undistortion import Undistorter

WITHOUT = "--sequence says where it is now, --no-images does without"


class Images:
    """Color images by frame, without distortion where that is asked for.

    rows: which frame of the sequence each frame of the run is
    """

    def __init__(
        self, sequence: Sequence, rows: Mapping[int, int], camera: Camera, undistort: bool = False
    ) -> None:
        self._sequence = sequence
        self._rows = rows
        self._undistort = Undistorter(camera) if undistort and camera.model != "pinhole" else None

    def bgr(self, frame_id: int) -> np.ndarray:
        """(H, W, 3) uint8 as OpenCV writes it: blue first. Raises FrameError where it cannot be read."""
        image = cv2.cvtColor(
            self._sequence.color(self._rows[frame_id]).contiguous().numpy(), cv2.COLOR_RGB2BGR
        )
        return image if self._undistort is None else self._undistort(image)


def open_images(source: str, scene: Scene, undistort: bool = False, fps: float | None = None) -> Images:
    """The images that the frames of a scene are from, at the size that the run saw them in.

    fps: at which the run read them, which is the time of images that have none

    They are found by their times: the run may have read a part of the sequence.
    Raises ResultsError where it is gone or another one.
    """
    times = dict(zip(scene.frame_ids.tolist(), scene.timestamps.tolist(), strict=True))
    try:
        sequence = open_sequence(source)
        if fps is not None and not set(times.values()) <= set(sequence.timestamps.tolist()):
            sequence = open_sequence(source, fps=fps)
        if sequence.size != scene.camera.size:
            sequence = resize(sequence, "{}x{}".format(*scene.camera.size))
    except SequenceError as error:
        raise ResultsError(f"the sequence of this run cannot be read: {error}; {WITHOUT}") from None
    row_at = {time: row for row, time in enumerate(sequence.timestamps.tolist())}
    if not all(time in row_at for time in times.values()):
        raise ResultsError(
            f"{source}: not the sequence of this run, whose frames have other times; {WITHOUT}"
        )
    rows = {frame_id: row_at[time] for frame_id, time in times.items()}
    return Images(sequence, rows, scene.camera, undistort)


def write_images(folder: Path, scene: Scene, images: Images) -> None:
    """Write the image of every frame as PNG, under its name; images of another export are removed."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("[0-9]" * 6 + ".png"):
        old.unlink()
    for frame_id, name in zip(scene.frame_ids.tolist(), scene.image_names, strict=True):
        if not cv2.imwrite(str(folder / name), images.bgr(frame_id)):
            raise ResultsError(f"{folder / name}: cannot be written")
