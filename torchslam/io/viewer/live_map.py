"""live.npz: the map and the path of a run that is going on, for a program that watches it (`torchslam app`)."""

from __future__ import annotations

import io
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchslam.errors import ResultsError
from torchslam.io.export.recording import gaps
from torchslam.io.file_names import LIVE
from torchslam.io.plots.charts import thin
from torchslam.io.viewer.frames import tracked_pixels
from torchslam.io.viewer.page import MAX_POINTS, clearest_observations, image_corners
from torchslam.system.slam import SLAM
from torchslam.types import State, StepResult
from torchslam.utils.files import PART, read_bytes

EVERY_S = 0.5
"""Shortest time between two files, seconds. Tried at 0.5 only: a person sees the map grow."""
SHARE = 0.02
"""Largest share of the run's processor time that writing takes. Tried at 0.02 only: 5 % are to be the most."""
PATIENCE_S = 2.0
"""Seconds after which a frame that is no keyframe is shown as well. Tried at 2 only."""
MAX_PATH = 5_000  # poses of the path in the file: 100 bytes each
MAX_BYTES = 1 << 24  # of the file: three times what `MAX_POINTS` and `MAX_PATH` take


class LiveMap:
    """Writes the file after keyframes, at most every `EVERY_S`, without waiting for the disk."""

    def __init__(self, slam: SLAM, folder: Path) -> None:
        self._slam, self._path = slam, folder / LIVE
        self._next, self._next_cpu, self._shown = 0.0, 0.0, list[int]()  # seconds of both clocks
        self._uncertain = list[float]()

    def offer(self, result: StepResult) -> None:
        """Write the file after a frame if it is due."""
        if result.state is State.UNCERTAIN:
            self._uncertain.append(result.timestamp)
        start = time.process_time()
        patience = 0.0 if result.is_keyframe else PATIENCE_S
        if time.monotonic() < self._next + patience or start < self._next_cpu:
            return
        if result.is_keyframe:
            self._shown.append(result.index)
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
            frame, state, keyframe: of the last frame
            size, corners: (2,) width and height; (4, 3) rays through the corners of the image
            keypoints, tracked: (N, 2), (M, 2) pixels of the last frame, as of `FrameSnapshot`
            points: (P, 3) in the world of the map
            seen_frame, seen_pixel: (P,), (P, 2) a frame that was shown before with the point, -1 without one; pixels
            poses: (F, 3, 4) camera to world, in order of time
            uncertain: (F,) whether the pose was uncertain when it was found
            breaks: rows before which the path is interrupted
        """
        slam = self._slam
        session, slam_map, seen = slam.session.number, slam.map, slam.last_features
        empty = torch.zeros(0, 2, dtype=torch.float32, device="cpu")
        arrays: dict[str, Any] = {
            "frame": result.index,
            "state": result.state.value,
            "keyframe": result.is_keyframe,
            "size": np.array(slam.camera.size),
            "corners": image_corners(slam.camera.to("cpu")),
            "keypoints": empty if seen is None else seen.keypoints[seen.mask].float().cpu(),
            "tracked": tracked_pixels(slam, result.index).float().cpu(),
        }
        path = slam.posed_frames.trajectory(slam_map, session)
        rows = thin(len(path), MAX_PATH)
        times = path.timestamps[rows]
        arrays |= {
            "poses": path.T_wc[rows, :3].float().cpu(),
            "uncertain": np.isin(times.numpy(), self._uncertain),
            "breaks": np.array(gaps(times), dtype=np.int64),
        }
        points = torch.zeros(0, 3, dtype=torch.float32, device="cpu")
        frames, pixels = torch.zeros(0, dtype=torch.int64, device="cpu"), empty
        if slam_map.num_points:
            ids = slam_map.valid_points()
            ids = ids[thin(len(ids), MAX_POINTS)]
            keyframes = slam_map.keyframe_rows(session)
            was_shown = torch.isin(
                slam_map.keyframes["frame_index"][keyframes],
                torch.tensor(self._shown, device=keyframes.device),
            )
            size = slam.camera.size
            frames, pixels = clearest_observations(slam_map, ids, keyframes[was_shown], size)
            points = slam_map.positions_w[ids].float()
        arrays |= {"points": points.cpu(), "seen_frame": frames.cpu(), "seen_pixel": pixels.float().cpu()}
        return {name: np.asarray(value) for name, value in arrays.items()}


def read_live_map(folder: Path) -> dict[str, Any] | None:
    """Read the file of a results folder; None if there is none. Raises ResultsError if it is damaged."""
    path = folder / LIVE
    try:
        file = io.BytesIO(read_bytes(path, MAX_BYTES, "a live map"))
        with zipfile.ZipFile(file) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise ValueError("it is packed")  # a run writes it unpacked
        with np.load(file, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ResultsError(f"{path}: cannot be read: {error}") from None
