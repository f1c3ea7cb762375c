"""Reads images and results in a process of its own: a damaged file can end that process, but not the server.

The functions below run in that process, which alone imports torch; they return NumPy arrays.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import TimeoutError as TooLate
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchslam.errors import ResultsError, TorchslamError

Answer = TypeVar("Answer")
NICENESS = 10
"""Of the process, relative to the server: a run that is watched comes first. Tried at 10 only."""
PATIENCE_S = 120.0
"""Seconds after which reading is given up. Tried at this value only: two million points take 8."""
LIVE_SIDE = 480  # longer side of the image that is shown during a run, pixels
THUMBNAIL_SIDE = 96  # longer side of the images in the frusta, pixels
MAX_KEPT = 600  # images that are kept to color the points of a run: 0.2 MB each
UNSEEN = (150, 155, 165)  # red, green, blue of points without an image


class ReadingProcess:
    """Calls functions in the other process, one after the other; it is started again after it has ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool = self._start()

    def call(self, function: Callable[..., Answer], *arguments: Any) -> Answer:
        """Return what a function of this module returns. Raises TorchslamError, also if its process ended."""
        with self._lock:
            try:
                return self._pool.submit(function, *arguments).result(PATIENCE_S)
            except (BrokenProcessPool, TooLate) as error:
                self.close()
                self._pool = self._start()
                why = (
                    f"takes more than {PATIENCE_S:g} s" if isinstance(error, TooLate) else "ended its process"
                )
                raise ResultsError(f"reading {arguments[0]} {why}: the file may be damaged") from None

    def close(self) -> None:
        """End the process, whatever it does."""
        processes = multiprocessing.active_children()
        self._pool.shutdown(wait=False, cancel_futures=True)
        for each in processes:
            each.kill()

    def _start(self) -> ProcessPoolExecutor:
        pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin)
        pool.submit(_ready)  # now rather than with the first image
        return pool


def _begin() -> None:
    import cv2
    import torch

    os.nice(NICENESS)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _ready() -> None:
    import torchslam.cli.run
    import torchslam.io.viewer.page  # noqa: F401


class _Watched:
    """The images of a run that goes on, as they are shown: read once, in the order of time if possible."""

    def __init__(self, words: tuple[str, ...]) -> None:
        from torchslam.cli import arguments, run

        parser = argparse.ArgumentParser()
        run.add_arguments(parser)
        self._sequence = arguments.sequence(parser.parse_args(words))
        self._images = dict[int, np.ndarray]()

    def image(self, frame: int) -> np.ndarray:
        """The (H, W, 3) image of a frame: red, green, blue; not larger than it is shown."""
        if frame not in self._images:
            if len(self._images) >= MAX_KEPT:
                self._images.pop(next(iter(self._images)))
            self._images[frame] = small(self._sequence.color(frame).numpy(), LIVE_SIDE)
        return self._images[frame]

    def colors(self, frames: np.ndarray, pixels: np.ndarray, size: np.ndarray) -> np.ndarray:
        """The (N, 3) colors of image points in frames that were shown; `UNSEEN` for the others."""
        colors = np.full((len(frames), 3), UNSEEN, np.uint8)
        for frame in np.unique(frames):
            image = self._images.get(int(frame))
            if image is not None:
                rows = frames == frame
                at = np.round(pixels[rows] * (image.shape[1] / size[0])).astype(int)
                high = np.array([image.shape[1], image.shape[0]]) - 1
                x, y = np.clip(at, 0, high).T
                colors[rows] = image[y, x]
        return colors


@lru_cache(maxsize=1)
def _watched(folder: Path, words: tuple[str, ...]) -> _Watched:
    return _Watched(words)


def live(folder: Path, words: tuple[str, ...], shown: int) -> dict[str, Any] | None:
    """The content of live.npz with the colors of the points and the image of the frame, its keypoints drawn.

    Args:
        folder: of the run.
        words: its arguments, after `run`.
        shown: the frame that is shown already: None is returned for it, and where there is no file.
    """
    import cv2

    from torchslam.io.viewer.frames import COLORS
    from torchslam.io.viewer.live_map import read_live_map
    from torchslam.types import State

    found = read_live_map(folder)
    if found is None or int(found["frame"]) == shown:
        return None
    watched, frame, size = _watched(folder, words), int(found["frame"]), found["camera"][4:]
    image = watched.image(frame)
    found["colors"] = watched.colors(found["seen_frame"], found["seen_pixel"], size)
    drawn, scale = image.copy(), image.shape[1] / size[0]
    own = COLORS[State(str(found["state"]))][::-1]
    for pixels, color, radius in ((found["keypoints"], (160, 160, 160), 1), (found["tracked"], own, 2)):
        for x, y in np.round(pixels * scale).astype(int).tolist():
            cv2.circle(drawn, (x, y), radius, color, 1, cv2.LINE_AA)
    return found | {"image": drawn}


def result(folder: Path) -> dict[str, Any]:
    """The data of view.html of a results folder with arrays instead of text, and the summary of its metrics.

    Raises TorchslamError if it is damaged.
    """
    from torchslam.io.report import summary
    from torchslam.io.results import read_results
    from torchslam.io.viewer.page import decoded, page_data

    results = read_results(folder)

    def arrays(value: Any) -> Any:
        if isinstance(value, dict):
            is_array = value.keys() == {"type", "data"}
            return decoded(value) if is_array else {key: arrays(each) for key, each in value.items()}
        return value

    data = arrays(page_data(results))
    data["submaps"] = [arrays(submap) for submap in data["submaps"]]
    camera = results.camera.params[:4].tolist()
    check = results.metrics.get("check") or {}
    rows = summary(results.metrics) if results.metrics["frames"] else {}
    return data | {
        "camera": camera,
        "summary": rows,
        "breaks": check.get("breaks", []),
        "failure": data["failure"],
    }


def thumbnails(folder: Path, frames: list[int], side: int = THUMBNAIL_SIDE) -> dict[int, np.ndarray]:
    """Small images of keyframes: red, green, blue; those that cannot be read are missing."""
    from torchslam.errors import FrameError
    from torchslam.io.results import open_run

    run = open_run(folder)
    if run.main is None:
        return {}
    images, found = run.images(run.scene(run.main, keyframes_alone=True)), {}
    for frame in frames:
        try:
            found[frame] = small(images.bgr(frame)[..., ::-1], side)
        except FrameError:
            continue
    return found


def residuals(folder: Path, frame: int) -> tuple[np.ndarray, str]:
    """The image of a keyframe with its observations and ten times their residuals; and these in words.

    Raises TorchslamError if the image cannot be read, or the frame is no keyframe.
    """
    import cv2

    from torchslam.geometry import transform
    from torchslam.io.results import open_run

    run = open_run(folder)
    if run.main is None:
        raise ResultsError("there is no map")
    scene = run.scene(run.main, keyframes_alone=True)
    rows = (scene.frame_ids == frame).nonzero()[:, 0]
    if not len(rows):
        raise ResultsError(f"frame {frame} is no keyframe")
    seen = scene.frame_index == rows[0]
    points_c = transform(scene.T_cw[rows[0]], scene.points_w[scene.point_index[seen]])
    expected, observed = scene.camera.project(points_c)[0].numpy(), scene.pixels[seen].numpy()
    image = run.images(scene).bgr(frame)[..., ::-1]
    drawn = small(image, 2 * LIVE_SIDE)
    scale = drawn.shape[1] / image.shape[1]
    for pixel, residual in zip(observed, expected - observed, strict=True):
        start, end = (np.round(scale * each).astype(int).tolist() for each in (pixel, pixel + 10 * residual))
        cv2.line(drawn, start, end, (230, 70, 60), 1, cv2.LINE_AA)
        cv2.circle(drawn, start, 2, (87, 190, 65), 1, cv2.LINE_AA)
    errors = np.linalg.norm(expected - observed, axis=1)
    middle = f", median residual {np.median(errors):.2f} px (drawn ten times as long)" if len(errors) else ""
    return drawn, f"frame {frame}: {len(errors)} points{middle}"


def compared(folder: Path, other: Path, is_truth: bool) -> tuple[np.ndarray, str]:
    """Another path, aligned with that of a results folder by a similarity, in the axes in which that is shown.

    Args:
        folder: the results.
        other: the file of the other path.
        is_truth: whether it is true: then errors are in its meters, else in units of the results.

    Returns:
        The (N, 3) positions, and the error in words. Raises TorchslamError for too few frames at the same times.
    """
    import torch

    from torchslam.data.trajectories import read_trajectory
    from torchslam.evaluation import evaluate
    from torchslam.geometry import transform
    from torchslam.io.results import TRAJECTORY, read_results
    from torchslam.io.viewer.page import page_data

    own, theirs = read_trajectory(folder / TRAJECTORY), read_trajectory(other)
    found = evaluate(own, theirs) if is_truth else evaluate(theirs, own)
    S_own_theirs = found.S_groundtruth_estimate
    S_own_theirs = torch.linalg.inv(S_own_theirs) if is_truth else S_own_theirs
    shown = torch.tensor(page_data(read_results(folder))["submaps"][0]["S_shown_map"], dtype=torch.float64)
    what = "ATE" if is_truth else "difference"
    unit = "m" if is_truth else "units of this result"
    words = f"{what} {found.ate_m:.4g} {unit} RMSE after Sim(3) alignment, over {len(found.errors_m)} frames"
    return transform(shown @ S_own_theirs, theirs.positions_w).float().numpy(), words


def small(image: np.ndarray, side: int) -> np.ndarray:
    """An image that is reduced to a longer side; a smaller one as it is."""
    import cv2

    scale = min(1.0, side / max(image.shape[:2]))
    size = [max(1, round(scale * each)) for each in image.shape[1::-1]]
    return np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def what_failed(error: Exception) -> str:
    """The words of an error of reading."""
    return str(error) if isinstance(error, TorchslamError | OSError) else f"{type(error).__name__}: {error}"
