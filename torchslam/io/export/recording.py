"""Recordings for the rerun viewer: the map, the way of the camera, and what its keyframes saw."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.geometry.transforms import corner_camera, corner_pixels
from torchslam.io.export.images import Images
from torchslam.io.export.scene import Scene

APPLICATION = "torchslam"
JPEG_QUALITY = 90
CAMERA = "world/camera"
KEYFRAME = "world/keyframe"
UNPAINTED = (125, 135, 148)  # points before images have colored them
TRACKED = (87, 190, 65)  # keypoints
GAP = 5  # usual intervals without a pose that break the line of the path


def import_rerun() -> ModuleType:
    """The module `rerun`. Raises ResultsError that says how to get it."""
    try:
        import rerun
    except ImportError:
        raise ResultsError("a recording needs rerun: pip install 'torchslam[rerun]'") from None
    return rerun


class Recorder:
    """Writes what a scene is made of to a recording of rerun: all that torchslam logs is named here.

    The entities that were given a lens, say `world/camera`, have poses, images and keypoints; pixels have their origin
    in the center of the top left one.
    """

    def __init__(self, recording: Any) -> None:
        """recording: a `rerun.RecordingStream`"""
        self._rr, self._recording = import_rerun(), recording

    def world(self, up: str) -> None:
        """What axes the world has: "RIGHT_HAND_Z_UP", or "RDF" for one that was a camera's."""
        self._log("world", getattr(self._rr.ViewCoordinates, up), static=True)

    def lens(self, entity: str, camera: Camera) -> None:
        """The camera at an entity. A pinhole is all that rerun knows."""
        lens = self._rr.Pinhole(
            image_from_camera=_numpy(corner_camera(camera).K),
            resolution=camera.size,
            camera_xyz=self._rr.ViewCoordinates.RDF,
        )
        self._log(entity, lens, static=True)

    def points(self, points_w: Tensor, colors: Tensor | None) -> None:
        """The points (P, 3) of the map, in the place of those before, with or without colors (P, 3) uint8."""
        content = self._rr.Points3D(
            _numpy(points_w), colors=UNPAINTED if colors is None else colors.cpu().numpy()
        )
        self._log("world/points", content, static=True)

    def path(self, positions_w: Tensor, breaks: list[int]) -> None:
        """The path (F, 3), in the place of that before, broken before some rows."""
        strips = [_numpy(part) for part in torch.tensor_split(positions_w, breaks)]
        self._log("world/path", self._rr.LineStrips3D(strips), static=True)

    def at(self, frame: int, seconds: float) -> None:
        """What is logged from now on belongs to a frame."""
        self._recording.set_time("frame", sequence=frame)
        self._recording.set_time("time", duration=seconds)

    def pose(self, entity: str, T_wc: Tensor) -> None:
        """Where a camera is: (4, 4)."""
        pose = _numpy(T_wc)
        self._log(entity, self._rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))

    def keypoints(self, entity: str, pixels: Tensor, colors: Tensor | None = None) -> None:
        """The keypoints (N, 2) that a camera sees; colors (N, 3) uint8."""
        content = self._rr.Points2D(
            _numpy(corner_pixels(pixels)),
            colors=TRACKED if colors is None else colors.cpu().numpy(),
            radii=2.0,
        )
        self._log(f"{entity}/keypoints", content)

    def image(self, entity: str, image: np.ndarray) -> None:
        """What a camera sees: uint8, gray or blue, green, red."""
        _, content = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))
        self._log(entity, self._rr.EncodedImage(contents=content.tobytes(), media_type="image/jpeg"))

    def words(self, entity: str, words: str) -> None:
        """A line of the log."""
        self._log(entity, self._rr.TextLog(words))

    def _log(self, entity: str, content: Any, static: bool = False) -> None:
        self._recording.log(entity, content, static=static)


def write_recording(path: Path, scene: Scene, R_up: Tensor, images: Images | None) -> None:
    """Write a .rrd file with the timelines `frame` and `time`, in a world whose z is up.

    `world/camera` has the pose of every frame, `world/keyframe` pose, image and observed keypoints of those that are
    one; a pinhole camera is all that rerun knows, so the scene must be undistorted.

    R_up:   (3, 3) from the map's world to the upright one
    images: of the keyframes, undistorted like the scene; none where None
    """
    upright = scene.turned(R_up)
    recording = import_rerun().RecordingStream(APPLICATION)
    recording.save(path)
    recorder = Recorder(recording)
    recorder.world("RIGHT_HAND_Z_UP")
    recorder.points(upright.points_w, scene.colors)
    recorder.path(upright.T_wc[:, :3, 3], gaps(scene.frame_ids))
    for entity in (CAMERA, KEYFRAME):
        recorder.lens(entity, scene.camera)
    for row in range(len(scene.T_cw)):
        recorder.at(int(scene.frame_ids[row]), float(scene.timestamps[row] - scene.timestamps[0]))
        recorder.pose(CAMERA, upright.T_wc[row])
        if scene.is_keyframe[row]:
            seen = scene.frame_index == row
            recorder.pose(KEYFRAME, upright.T_wc[row])
            recorder.keypoints(KEYFRAME, scene.pixels[seen], scene.colors[scene.point_index[seen]])
            if images is not None:
                recorder.image(KEYFRAME, images.bgr(int(scene.frame_ids[row])))
    recording.flush()
    recording.disconnect()


def _numpy(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()


def gaps(times: Tensor) -> list[int]:
    """Rows before which the path is broken. times: (F,) ascending, frames or seconds."""
    if len(times) < 3:
        return []
    steps = times.diff()
    return (torch.nonzero(steps > GAP * steps.median())[:, 0] + 1).tolist()
