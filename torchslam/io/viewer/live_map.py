"""live.npz: what a run that goes on looks like, for a program that watches it (`torchslam app`)."""

from __future__ import annotations

import io
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchslam.data.sequence import Sequence
from torchslam.data.transforms import reduced
from torchslam.errors import FrameError
from torchslam.io.export.recording import gaps
from torchslam.io.file_names import LIVE
from torchslam.io.plots.charts import thin
from torchslam.io.viewer.frames import COLORS, draw_keypoints, tracked_pixels
from torchslam.io.viewer.page import MAX_POINTS, clearest_observations, image_corners
from torchslam.system.slam import SLAM
from torchslam.types import State, StepResult
from torchslam.utils.files import PART

EVERY_S = 0.5
"""Shortest time between two files, seconds. Tried at 0.5 only: a person sees the map grow."""
SHARE = 0.02
"""Largest share of the run's processor time that writing takes. Tried at 0.02 only: 5 % are to be the most."""
PATIENCE_S = 2.0
"""Seconds after which a frame that is no keyframe is shown as well. Tried at 2 only."""
MAX_PATH = 5_000  # poses of the path in the file: 100 bytes each
MAX_KEPT, KEPT_SIDE = 600, 240
"""Keyframes whose pictures are kept to color the points, at least five minutes; and the longer side of these, which
take 0.13 MB each. Tried at these values only."""
UNSEEN = (150, 155, 165)  # red, green, blue of points without a picture


class LiveMap:
    """Writes the file after keyframes, at most every `EVERY_S`, without waiting for the disk."""

    def __init__(self, slam: SLAM, sequence: Sequence, folder: Path) -> None:
        self._slam, self._sequence, self._path = slam, sequence, folder / LIVE
        self._next, self._next_cpu = 0.0, 0.0  # seconds of both clocks
        self._kept = dict[int, np.ndarray]()  # pictures of keyframes, by frame
        self._uncertain = list[float]()

    def offer(self, result: StepResult) -> None:
        """Write the file after a frame if it is due."""
        if result.state is State.UNCERTAIN:
            self._uncertain.append(result.timestamp)
        start = time.process_time()
        patience = 0.0 if result.is_keyframe else PATIENCE_S
        if time.monotonic() < self._next + patience or start < self._next_cpu:
            return
        content = io.BytesIO()
        np.savez(content, **self._arrays(result))
        part = self._path.with_name(self._path.name + PART)
        part.write_bytes(content.getbuffer())
        part.replace(self._path)
        end = time.process_time()
        self._next, self._next_cpu = time.monotonic() + EVERY_S, end + (end - start) / SHARE

    def _arrays(self, result: StepResult) -> dict[str, Any]:
        """The content of the file.

        Returns:
            frame: index of the last one
            image: its (H, W, 3) picture, red, green, blue, with its keypoints; (0, 0, 3) if it cannot be read again
            corners: (4, 3) rays through the corners of the image
            points, colors: (P, 3), (P, 3) in the world of the map; red, green, blue
            poses: (F, 3, 4) camera to world, in order of time
            uncertain: (F,) whether the pose was uncertain when it was found
            breaks: rows before which the path is interrupted
        """
        slam = self._slam
        session, slam_map = slam.session.number, slam.map
        image = self._image(result)
        corners = image_corners(slam.camera.to("cpu"))
        arrays: dict[str, Any] = {"frame": result.index, "image": image, "corners": corners}
        path = slam.posed_frames.trajectory(slam_map, session)
        rows = thin(len(path), MAX_PATH)
        times = path.timestamps[rows]
        arrays |= {
            "poses": path.T_wc[rows, :3].float().cpu(),
            "uncertain": np.isin(times.numpy(), self._uncertain),
            "breaks": np.array(gaps(times), dtype=np.int64),
        }
        arrays |= {"points": np.zeros((0, 3), np.float32), "colors": np.zeros((0, 3), np.uint8)}
        if slam_map.num_points:
            ids = slam_map.valid_points()
            ids = ids[thin(len(ids), MAX_POINTS)]
            keyframes = slam_map.keyframe_rows(session)
            was_kept = torch.isin(
                slam_map.keyframes["frame_index"][keyframes],
                torch.tensor(list(self._kept), dtype=torch.int64, device=keyframes.device),
            )
            seen = clearest_observations(slam_map, ids, keyframes[was_kept], slam.camera.size)
            arrays["colors"] = self._colors(*(each.cpu().numpy() for each in seen))
            arrays["points"] = slam_map.positions_w[ids].float().cpu()
        return {name: np.asarray(value) for name, value in arrays.items()}

    def _image(self, result: StepResult) -> np.ndarray:
        """The picture of the last frame with its keypoints; that of a keyframe is kept to color its points."""
        slam, seen = self._slam, self._slam.last_features
        try:
            sequence = self._sequence.unzoomed(slam.zoom)
            sent = slam.last_picture
            image = reduced(sequence.color(result.index).numpy()) if sent is None else sent.numpy().copy()
        except FrameError:  # only gray, as of a live source; the run goes on, and the page shows no picture
            return np.zeros((0, 0, 3), np.uint8)
        if result.is_keyframe:
            if len(self._kept) >= MAX_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[result.index] = reduced(image, KEPT_SIDE)
        scale = image.shape[1] / slam.camera.width
        if seen is not None:
            draw_keypoints(image, seen.keypoints[seen.mask].cpu().numpy() * scale, UNSEEN, 1)
        tracked = tracked_pixels(slam, result.index).cpu().numpy()
        draw_keypoints(image, tracked * scale, COLORS[result.state][::-1], 2)
        return image

    def _colors(self, frames: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """The (N, 3) colors of image points in frames whose pictures are kept; `UNSEEN` for the others."""
        colors = np.full((len(frames), 3), UNSEEN, np.uint8)
        for frame in self._kept.keys() & set(np.unique(frames).tolist()):
            image, rows = self._kept[frame], frames == frame
            at = np.round(pixels[rows] * (image.shape[1] / self._slam.camera.width)).astype(int)
            x, y = np.clip(at, 0, np.array(image.shape[1::-1]) - 1).T
            colors[rows] = image[y, x]
        return colors
