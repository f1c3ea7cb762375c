"""Recordings for the rerun viewer: map, camera path, images, keypoints and depth of the keyframes, the dense cloud."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Num, UInt8
from torch import Tensor

from torchslam.dense.cloud import PointCloud
from torchslam.dense.depth_maps import DepthMaps, read_frames
from torchslam.errors import ResultsError
from torchslam.geometry import Camera, rigid, se3_inverse
from torchslam.geometry.transforms import corner_camera, corner_pixels
from torchslam.io.export.nerfstudio import UNIT, depth_png
from torchslam.io.export.ply import MAX_DRAWN
from torchslam.io.export.scene import ExportedScene, Images

APPLICATION = "torchslam"
CAMERA = "world/camera"
KEYFRAME = "world/keyframe"
DEPTH = "world/depth"


def import_rerun() -> ModuleType:
    """Import rerun. Raises ResultsError with an installation hint if it is missing."""
    try:
        import rerun
    except ImportError:
        raise ResultsError("rerun is required for recordings: pip install 'torchslam[rerun]'") from None
    return rerun


class Recorder:
    """Writes the entities of torchslam to a rerun recording.

    Entities with a camera, such as `world/camera`, have poses, images and keypoints. Pixel (0, 0) is the center of the
    top left pixel.
    """

    def __init__(self, recording: Any) -> None:
        """recording: a `rerun.RecordingStream`"""
        self._rr, self._recording = import_rerun(), recording

    def world(self, up: str) -> None:
        """Set the axes of the world: "RIGHT_HAND_Z_UP", or "RDF" for camera axes."""
        self._log("world", getattr(self._rr.ViewCoordinates, up), static=True)

    def camera(self, entity: str, camera: Camera) -> None:
        """Set the pinhole camera of an entity; rerun has no other model."""
        pinhole = self._rr.Pinhole(
            image_from_camera=_numpy(corner_camera(camera).K),
            resolution=camera.size,
            camera_xyz=self._rr.ViewCoordinates.RDF,
        )
        self._log(entity, pinhole, static=True)

    def points(
        self,
        points_w: Float[Tensor, "N 3"],
        colors: UInt8[Tensor, "N 3"] | None,
        entity: str = "world/points",
    ) -> None:
        """Replace the points of the map, or another cloud, with or without colors."""
        painted = (125, 135, 148) if colors is None else _numpy(colors)
        self._log(entity, self._rr.Points3D(_numpy(points_w), colors=painted), static=True)

    def path(self, positions_w: Float[Tensor, "K 3"], breaks: list[int]) -> None:
        """Replace the path, interrupted before some rows."""
        strips = [_numpy(part) for part in torch.tensor_split(positions_w, breaks)]
        self._log("world/path", self._rr.LineStrips3D(strips), static=True)

    def at(self, frame: int, seconds: float) -> None:
        """Set the frame and time of the following entries."""
        self._recording.set_time("frame", sequence=frame)
        self._recording.set_time("time", duration=seconds)

    def pose(self, entity: str, T_wc: Float[Tensor, "4 4"]) -> None:
        """Log the pose of a camera."""
        pose = _numpy(T_wc)
        self._log(entity, self._rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))

    def keypoints(
        self, entity: str, pixels: Float[Tensor, "N 2"], colors: UInt8[Tensor, "N 3"] | None = None
    ) -> None:
        """Log the keypoints of a camera."""
        painted = (87, 190, 65) if colors is None else _numpy(colors)
        content = self._rr.Points2D(_numpy(corner_pixels(pixels)), colors=painted, radii=2.0)
        self._log(f"{entity}/keypoints", content)

    def image(self, entity: str, image: UInt8[np.ndarray, "H W *channels"]) -> None:
        """Log the image of a camera, gray or BGR."""
        _, content = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 90))
        self._log(entity, self._rr.EncodedImage(contents=content.tobytes(), media_type="image/jpeg"))

    def depth(self, entity: str, depth: Float[Tensor, "H W"]) -> None:
        """Log the depth image of a camera, in map units; 0 where unknown."""
        content = self._rr.EncodedDepthImage(depth_png(depth), media_type="image/png", meter=1 / UNIT)
        self._log(entity, content)

    def text(self, entity: str, text: str) -> None:
        """Log a line of text."""
        self._log(entity, self._rr.TextLog(text))

    def _log(self, entity: str, content: Any, static: bool = False) -> None:
        self._recording.log(entity, content, static=static)


def write_recording(
    path: Path,
    scene: ExportedScene,
    R_up: Float[Tensor, "3 3"],
    images: Images | None,
    cloud: PointCloud | None = None,
    depths: Path | None = None,
) -> None:
    """Write a .rrd file with the timelines `frame` and `time`, in a world whose z is up.

    `world/camera` has the pose of every frame, `world/keyframe` pose, image and observed keypoints of those that are
    one, `world/depth` pose and depth image of frames with a depth map. A pinhole camera is all that rerun knows, so the
    scene must be undistorted.

    Args:
        R_up: rotation from the map's world to the upright one
        images: undistorted images of the keyframes; None: no images
        cloud: a dense cloud in the map's world
        depths: the file of depth maps
    """
    upright = scene.turned(R_up)
    recording = import_rerun().RecordingStream(APPLICATION)
    recording.save(path)
    recorder = Recorder(recording)
    recorder.world("RIGHT_HAND_Z_UP")
    recorder.points(upright.points_w, scene.colors)
    if cloud is not None:
        dense = cloud.thinned(MAX_DRAWN).turned(R_up)
        recorder.points(dense.points_w, dense.colors, "world/dense")
    recorder.path(upright.T_wc[:, :3, 3], gaps(scene.frame_ids))
    for entity in (CAMERA, KEYFRAME):
        recorder.camera(entity, scene.camera)
    for row in range(len(scene.T_cw)):
        recorder.at(int(scene.frame_ids[row]), float(scene.timestamps[row] - scene.timestamps[0]))
        recorder.pose(CAMERA, upright.T_wc[row])
        if scene.is_keyframe[row]:
            seen = scene.frame_index == row
            recorder.pose(KEYFRAME, upright.T_wc[row])
            recorder.keypoints(KEYFRAME, scene.pixels[seen], scene.colors[scene.point_index[seen]])
            if images is not None:
                recorder.image(KEYFRAME, images.bgr(int(scene.frame_ids[row])))
    if depths is not None:
        frame_ids, camera = read_frames(depths)
        seconds = scene.of_frames(frame_ids).timestamps - scene.timestamps[0]
        turn = rigid(R_up.double(), torch.zeros(3, dtype=torch.float64, device="cpu"))
        recorder.camera(DEPTH, camera)
        for maps, time in zip(DepthMaps.blocks(depths, 1), seconds.tolist(), strict=True):
            recorder.at(int(maps.frame_index), time)
            recorder.pose(DEPTH, turn @ se3_inverse(maps.T_cw[0].double()))
            recorder.depth(DEPTH, maps.depth[0])
    recording.flush()
    recording.disconnect()


def _numpy(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()


def gaps(times: Num[Tensor, " K"]) -> list[int]:
    """Return the rows before which the path is interrupted, for five usual intervals of ascending frames or seconds."""
    if len(times) < 3:
        return []
    steps = times.diff()
    return (torch.nonzero(steps > 5 * steps.median())[:, 0] + 1).tolist()
