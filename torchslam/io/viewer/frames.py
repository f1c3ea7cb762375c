"""Live viewers of a run: rerun, and a video of the tracked frames."""

from __future__ import annotations

import shutil
import sys
import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchslam.data.sequence import Sequence, Transformed
from torchslam.errors import ResultsError
from torchslam.geometry import se3_inverse
from torchslam.io.export.recording import APPLICATION, CAMERA, Recorder, gaps, import_rerun
from torchslam.io.export.scene import Undistorter, pinhole_within, undistorted_pixels
from torchslam.map.map import Map
from torchslam.system.run import Run
from torchslam.system.slam import SLAM
from torchslam.types import State, StepResult, Trajectory

VIDEO = "tracked.mp4"
BAR = 26  # pixels, for the text under the image
COLORS = {  # blue, green, red
    State.INITIALIZING: (170, 200, 215),
    State.TRACKING: (65, 190, 87),
    State.UNCERTAIN: (225, 130, 190),
    State.LOST: (61, 85, 200),
}


class FrameSnapshot(NamedTuple):
    """One frame, gray, and its tracking result: all keypoints, and those of map points that support a reliable pose."""

    result: StepResult
    image: UInt8[np.ndarray, "H W"]
    keypoints: Float[Tensor, "N 2"]
    tracked: Float[Tensor, "M 2"]


class FrameViewer:
    """A viewer, which shows frames one after the other."""

    def show(self, snapshot: FrameSnapshot) -> None:
        """Show a processed frame."""

    def end(self, run: Run) -> None:
        """Show the result of the run."""

    def close(self) -> None:
        """Release files and connections."""


class FrameViewers(ExitStack):
    """Passes every processed frame on to the viewers, and closes them at its exit.

    `sequence` is to be run instead of the original one; it keeps the last image, so that no image is read twice.
    """

    def __init__(self, slam: SLAM, sequence: Sequence, screens: list[FrameViewer]) -> None:
        super().__init__()
        self._slam, self._screens = slam, screens
        for screen in screens:
            self.callback(screen.close)
        self._memory = _Memory(sequence) if screens else None
        self.sequence = self._memory or sequence

    def show(self, result: StepResult) -> None:
        """After a frame."""
        if self._memory is None:
            return
        seen = self._slam.last_features
        assert self._memory.last is not None  # the frame's own
        assert seen is not None
        snapshot = FrameSnapshot(
            result,
            (self._memory.last[0, 0] * 255.0).round().to(torch.uint8).cpu().numpy(),
            seen.keypoints[seen.mask],
            tracked_pixels(self._slam, result.index),
        )
        for screen in self._screens:
            screen.show(snapshot)

    def end(self, run: Run) -> None:
        """After the last frame, and all that was learned since."""
        for screen in self._screens:
            screen.end(run)


class _Memory(Transformed):
    """The same sequence, which remembers the last image that was read."""

    last: Tensor | None = None

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        self.last = super().image(index)
        return self.last


def tracked_pixels(slam: SLAM, index: int) -> Float[Tensor, "M 2"]:
    """Pixels at which a frame of this session observes map points; none while its pose is unreliable."""
    frames, seen = slam.posed_frames.frames, slam.posed_frames.observations
    if len(frames) == 0 or len(seen) == 0:
        return torch.zeros(0, 2, dtype=torch.float64, device="cpu")
    is_it = (frames["frame_index"] == index) & (frames["session"] == slam.session.number)
    return seen["pixels"][torch.isin(seen["frame_row"], torch.nonzero(is_it)[:, 0])]


class LiveView(FrameViewer):
    """A viewer of rerun that follows a run: camera, image and keypoints of every frame, the map at every keyframe.

    The world is that of the map, y down. Images and keypoints are shown without distortion.
    """

    def __init__(self, slam: SLAM, recording: Any) -> None:
        """Raises ResultsError for a camera that no pinhole can stand for."""
        self._slam, self._recording, self._recorder = slam, recording, Recorder(recording)
        self._camera = slam.camera.to("cpu")
        self._pinhole = pinhole_within(self._camera)
        self._undistort = None if self._camera.model == "pinhole" else Undistorter(self._camera)
        self._start: float | None = None
        self._state: State | None = None
        self._recorder.world("RDF")
        self._recorder.camera(CAMERA, self._pinhole)

    @classmethod
    def spawn(cls, slam: SLAM) -> LiveView:
        """In a window of its own. Raises ResultsError where there is no rerun, or its viewer does not start."""
        rr = import_rerun()
        recording = rr.RecordingStream(APPLICATION)
        try:
            # The viewer comes with rerun, but is not on the path if the environment is not activated.
            executable = shutil.which("rerun", path=str(Path(sys.executable).parent))
            rr.spawn(recording=recording, executable_path=executable)
        except RuntimeError as error:
            raise ResultsError(f"--view: the viewer of rerun does not start: {error}") from None
        return cls(slam, recording)

    def show(self, snapshot: FrameSnapshot) -> None:
        result, recorder = snapshot.result, self._recorder
        self._start = result.timestamp if self._start is None else self._start
        recorder.at(result.index, result.timestamp - self._start)
        if result.T_cw is not None:
            recorder.pose(CAMERA, se3_inverse(result.T_cw))
        recorder.image(CAMERA, snapshot.image if self._undistort is None else self._undistort(snapshot.image))
        pixels = snapshot.tracked.cpu()
        if self._undistort is not None:
            pixels = undistorted_pixels(pixels.to(self._camera.params), self._camera, self._pinhole)
        recorder.keypoints(CAMERA, pixels)
        if result.state is not self._state:
            self._state = result.state
            recorder.text("state", ": ".join(filter(None, (result.state.value, result.reason))))
        if result.is_keyframe:
            slam = self._slam
            self._map(slam.map, slam.posed_frames.trajectory(slam.map, slam.session.number), painted=False)

    def end(self, run: Run) -> None:
        if len(run.trajectory):
            self._map(run.map, run.trajectory, painted=True)

    def close(self) -> None:
        try:
            self._recording.flush(timeout_sec=5.0)  # a viewer may have been closed
        except RuntimeError as error:  # the window was closed; the run goes on
            warnings.warn(f"the viewer of rerun did not get everything: {error}", stacklevel=2)
        self._recording.disconnect()

    def _map(self, slam_map: Map, path: Trajectory, painted: bool) -> None:
        ids = slam_map.valid_points()
        self._recorder.points(slam_map.positions_w[ids], slam_map.points["colors"][ids] if painted else None)
        self._recorder.path(path.positions_w, gaps(path.timestamps))


class VideoRecorder(FrameViewer):
    """tracked.mp4: every frame with its keypoints, those that hold the pose in the color of the state."""

    def __init__(self, path: Path, size: tuple[int, int], rate: float) -> None:
        """size: (width, height) of the images. Raises ResultsError where no film can be written."""
        self._scale = min(1.0, 960 / size[0])  # a small film
        # Codecs ask for even sides.
        self._size = (int(size[0] * self._scale) // 2 * 2, int(size[1] * self._scale) // 2 * 2)
        # An absolute path: FFmpeg takes what stands before a colon for a protocol, unless a slash comes first.
        self._writer = cv2.VideoWriter(
            str(path.absolute()), cv2.VideoWriter.fourcc(*"mp4v"), rate, (self._size[0], self._size[1] + BAR)
        )
        if not self._writer.isOpened():
            raise ResultsError(f"{path}: this OpenCV cannot write it")

    def show(self, snapshot: FrameSnapshot) -> None:
        result = snapshot.result
        small = cv2.resize(snapshot.image, self._size, interpolation=cv2.INTER_AREA)
        image, own = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), COLORS[result.state]
        for pixels, color, radius in ((snapshot.keypoints, (150, 150, 150), 1), (snapshot.tracked, own, 3)):
            draw_keypoints(image, (pixels * self._scale).cpu().numpy(), color, radius)
        image = cv2.copyMakeBorder(image, 0, BAR, 0, 0, cv2.BORDER_CONSTANT, value=(24, 21, 19))
        words = f"{result.index}  {result.state.value}  {result.inliers or ''}  {result.reason}"
        place = (8, image.shape[0] - 8)
        cv2.putText(image, words, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, own, 1, cv2.LINE_AA)
        self._writer.write(image)

    def close(self) -> None:
        self._writer.release()


def draw_keypoints(
    image: UInt8[np.ndarray, "H W 3"], pixels: Float[np.ndarray, "N 2"], color: tuple[int, ...], radius: int
) -> None:
    """Draw circles of a radius in pixels into an image."""
    for center in np.round(pixels).astype(int).tolist():
        cv2.circle(image, center, radius, color, 1, cv2.LINE_AA)


def film_of(sequence: Sequence, directory: Path) -> VideoRecorder:
    """Create the video of a run in the results folder, at the frame rate of the sequence."""
    rate = sequence.frame_rate if sequence.known_length is not None and len(sequence.timestamps) > 1 else 0.0
    return VideoRecorder(directory / VIDEO, sequence.size, rate or 30.0)
