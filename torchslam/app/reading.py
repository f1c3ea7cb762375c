"""Reads images and results in a process of its own: a damaged file can end that process, but not the server.

The functions below but `live` run in that process, which alone imports torch; they return NumPy arrays.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import threading
import zipfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import TimeoutError as TooLate
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchslam.errors import ResultsError, TorchslamError
from torchslam.io.file_names import LIVE
from torchslam.utils.files import read_bytes

Answer = TypeVar("Answer")
NICENESS = 5
"""Of the process, relative to the server: a run that is watched comes first. With 10 it starved on a busy machine."""
PATIENCE_S = 300.0
"""Seconds after which reading is given up. Tried at this value only."""
SIDE, THUMBNAIL_SIDE, MAX_THUMBNAILS = 960, 96, 24
"""Longer sides of the image of a keyframe and of those in the frusta, pixels; and number of the latter. An image takes
.2 ms of a frame where there is no GPU."""
MAX_BYTES = 1 << 24  # of a live map: three times what its points, poses and picture take
TIMELINE_INCHES = 5.0, 2.6  # width and height, of 100 pixels: about the width of the panel


class ReadingProcess:
    """Calls functions in the other process, one after the other; it is started again after it has ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool = self._start()

    def call(self, function: Callable[..., Answer], folder: Path, *arguments: Any) -> Answer:
        """Return what a function of this module returns. Raises TorchslamError, also if its process ended."""
        with self._lock:
            try:
                return self._pool.submit(function, folder, *arguments).result(PATIENCE_S)
            except (BrokenProcessPool, TooLate):
                self.close()
                self._pool = self._start()
        words = f"reading it ended its process, or took {PATIENCE_S:g} s: damaged files?"
        raise ResultsError(f"{folder.name}: {words}")

    def close(self) -> None:
        """End the process, whatever it does."""
        for each in multiprocessing.active_children():
            each.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _start(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin)


def _begin() -> None:
    import cv2
    import torch

    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_server() -> None:
        parent.join()
        os._exit(0)

    threading.Thread(target=end_with_server, daemon=True).start()  # however the server ends
    os.nice(NICENESS)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def live(folder: Path) -> dict[str, Any] | None:
    """Read what `LiveMap` writes, without torch; None if there is nothing yet. Raises ResultsError if it is damaged."""
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
    except (OSError, ValueError, MemoryError, zipfile.BadZipFile) as error:
        raise ResultsError(f"{path}: cannot be read: {error}") from None


def result(folder: Path) -> dict[str, Any]:
    """What the page shows of a run.

    Returns:
        summary, failure: of the run; words by name, and words
        timeline: (H, W, 3) picture of all frames
        submap: of the main submap, the data of view.html, with what is drawn beside: `uncertain` (F,) poses, `frames`
            (K,) of the keyframes, `size` of the images, `corners` (4, 3) of the frusta in their cameras, small `images`
            of keyframes by row; empty without a map
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from torchslam.data.transforms import reduced
    from torchslam.io.plots import plot_tracking
    from torchslam.io.plots.charts import thin
    from torchslam.io.report import summary
    from torchslam.io.results import read_results
    from torchslam.io.viewer.live_map import UNSEEN
    from torchslam.io.viewer.page import page_data
    from torchslam.types import State

    results = read_results(folder)
    data, rows = page_data(results), summary(results.metrics)
    frames, submap = data["frames"], dict[str, Any]()
    if results.main is not None and len(results.trajectory):
        submap = data["submaps"][0]
        submap["uncertain"] = frames["state"][submap["frame"]] == list(State).index(State.UNCERTAIN)
        submap["frames"], submap["size"] = frames["index"][submap["keyframe"]], data["size"]
        submap["corners"] = submap["frustum"] * np.array(data["corners"])
        images = submap["images"] = dict[int, np.ndarray]()
        try:
            opened = results.images(results.scene(results.main, keyframes_alone=True))
            for row in thin(len(submap["frames"]), MAX_THUMBNAILS).tolist():
                images[row] = reduced(opened.bgr(int(submap["frames"][row]))[..., ::-1], THUMBNAIL_SIDE)
        except (TorchslamError, OSError) as error:  # moved, or damaged
            rows["images"] = f"not shown: {error}"
        if not len(submap["colors"]):
            submap["colors"] = np.full(submap["points"].shape, UNSEEN, np.uint8)
    figure = plot_tracking(results.frames, breaks=results.breaks)
    figure.set_size_inches(TIMELINE_INCHES)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    rows |= {"breaks": "; ".join(results.breaks)} if results.breaks else {}
    picture = np.array(canvas.buffer_rgba())[..., :3]
    return {"summary": rows, "failure": data["failure"], "timeline": picture, "submap": submap}


def residuals(folder: Path, frame: int) -> tuple[np.ndarray, str]:
    """The image of a keyframe with its observations and ten times their residuals; and these in words."""
    import cv2

    from torchslam.data.transforms import reduced
    from torchslam.geometry import transform
    from torchslam.io.results import open_run
    from torchslam.io.viewer.frames import draw_keypoints

    run = open_run(folder)
    if run.main is None:
        raise ResultsError("there is no map")
    scene = run.scene(run.main, keyframes_alone=True)
    row = int((scene.frame_ids == frame).nonzero()[0, 0])
    seen = scene.frame_index == row
    points_c = transform(scene.T_cw[row], scene.points_w[scene.point_index[seen]])
    observed = scene.pixels[seen].numpy()
    residual = scene.camera.project(points_c)[0].numpy() - observed
    image = run.images(scene).bgr(frame)[..., ::-1]
    drawn = reduced(image, SIDE)
    scale = drawn.shape[1] / image.shape[1]
    ends = np.round(scale * np.stack((observed, observed + 10 * residual), axis=1)).astype(int).tolist()
    for start, end in ends:
        cv2.line(drawn, start, end, (230, 70, 60), 1, cv2.LINE_AA)
    draw_keypoints(drawn, scale * observed, (87, 190, 65), 2)
    middle = np.median(np.linalg.norm(residual, axis=1)) if len(observed) else np.nan
    words = f"{len(observed)} points, median residual {middle:.2f} px (drawn ten times as long)"
    return drawn, f"frame {frame}: {words}"


def compared(
    folder: Path, other: Path, is_truth: bool, S_shown_map: list[list[float]]
) -> tuple[np.ndarray, str]:
    """Another path, aligned by a similarity with that of a results folder in the axes in which it is shown.

    Returns:
        The (N, 3) positions, and the error in words: in meters of the other path if it is true, else in map units.
    """
    import torch

    from torchslam.data.trajectories import read_trajectory
    from torchslam.evaluation import evaluate
    from torchslam.geometry import transform
    from torchslam.io.results import TRAJECTORY

    own, theirs = read_trajectory(folder / TRAJECTORY), read_trajectory(other)
    found = evaluate(own, theirs) if is_truth else evaluate(theirs, own)
    S = torch.linalg.inv(found.S_groundtruth_estimate) if is_truth else found.S_groundtruth_estimate
    shown = torch.tensor(S_shown_map, dtype=torch.float64, device="cpu")
    what, unit = ("ATE", "m") if is_truth else ("difference", "units of this result")
    words = f"{what} {found.ate_m:.4g} {unit} RMSE after Sim(3) alignment, over {len(found.errors_m)} frames"
    return transform(shown @ S, theirs.positions_w).float().numpy(), words
