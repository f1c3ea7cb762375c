"""A recording for the rerun viewer: the map, the way of the camera, and what its keyframes saw."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import torch
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.export.conventions import corner_camera, corner_pixels
from torchslam.export.images import Images
from torchslam.export.scene import Scene

APPLICATION = "torchslam"
JPEG_QUALITY = 90
GAP = 5  # usual intervals without a pose that break the line of the path


def import_rerun() -> ModuleType:
    """The module `rerun`. Raises ResultsError that says how to get it."""
    try:
        import rerun
    except ImportError:
        raise ResultsError("a recording needs rerun: pip install 'torchslam[rerun]'") from None
    return rerun


def write_recording(path: Path, scene: Scene, R_up: Tensor, images: Images | None) -> None:
    """Write a .rrd file with the timelines `frame` and `time`, in a world whose z is up.

    `world/camera` has the pose of every frame, `world/keyframe` pose, image and observed keypoints of those that are
    one; a pinhole camera is all that rerun knows, so the scene must be undistorted.

    R_up:   (3, 3) from the map's world to the upright one
    images: of the keyframes, undistorted like the scene; none where None
    """
    rr, upright = import_rerun(), scene.turned(R_up)
    recording = rr.RecordingStream(APPLICATION)
    recording.save(path)
    lens = rr.Pinhole(
        image_from_camera=corner_camera(scene.camera).K.numpy(),
        resolution=scene.camera.size,
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    positions_w = upright.T_wc[:, :3, 3]
    strips = [part.numpy() for part in torch.tensor_split(positions_w, gaps(scene.frame_ids))]
    for entity, content in (
        ("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP),
        ("world/points", rr.Points3D(upright.points_w.numpy(), colors=scene.colors.numpy())),
        ("world/path", rr.LineStrips3D(strips)),
        ("world/camera", lens),
        ("world/keyframe", lens),
    ):
        recording.log(entity, content, static=True)
    for row in range(len(scene.T_cw)):
        recording.set_time("frame", sequence=int(scene.frame_ids[row]))
        recording.set_time("time", duration=float(scene.timestamps[row] - scene.timestamps[0]))
        T_wc = upright.T_wc[row].numpy()
        pose = rr.Transform3D(translation=T_wc[:3, 3], mat3x3=T_wc[:3, :3])
        recording.log("world/camera", pose)
        if scene.is_keyframe[row]:
            recording.log("world/keyframe", pose)
            _log_view(rr, recording, scene, row, images)
    recording.flush()
    recording.disconnect()


def _log_view(rr: ModuleType, recording: Any, scene: Scene, row: int, images: Images | None) -> None:
    """Log the observed keypoints of a keyframe, and its image beside the camera that took it."""
    seen = scene.frame_index == row
    pixels, colors = corner_pixels(scene.pixels[seen]), scene.colors[scene.point_index[seen]]
    recording.log("world/keyframe/keypoints", rr.Points2D(pixels.numpy(), colors=colors.numpy(), radii=2.0))
    if images is not None:
        quality = (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)
        _, content = cv2.imencode(".jpg", images.bgr(int(scene.frame_ids[row])), quality)
        recording.log("world/keyframe", rr.EncodedImage(contents=content.tobytes(), media_type="image/jpeg"))


def gaps(frame_ids: Tensor) -> list[int]:
    """Rows before which the path is broken."""
    if len(frame_ids) < 3:
        return []
    steps = frame_ids.diff()
    return (torch.nonzero(steps > GAP * steps.median())[:, 0] + 1).tolist()
