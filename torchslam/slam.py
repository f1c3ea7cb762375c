"""Monocular SLAM, the way of a frame:

frame -> features -> track (or initialise, or lose) -> keyframe? -> map -> StepResult
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError
from torchslam.front_end import Extractor, image_extractor
from torchslam.geometry import Camera
from torchslam.mapping.keyframes import why_keyframe
from torchslam.mapping.mapper import Mapper
from torchslam.run import Run, run_sequence
from torchslam.stopwatch import Stopwatch
from torchslam.tracking.initialization import Initializer
from torchslam.tracking.tracker import Tracker
from torchslam.values import Frame, Start, State, StepResult, Tracked, Trajectory, View
from torchslam.world.history import History
from torchslam.world.map import Map
from torchslam.world.world import World

MIN_KEYFRAMES = 4  # a map that is lost before it has this many was a bad start


class SLAM:
    """Give it frames one after the other; ask it for the map and the trajectory at any time.

    It works on the device of the camera: SLAM(camera.to("cuda")) runs on the GPU, wherever the images are.
    """

    def __init__(
        self, camera: Camera, config: Config | None = None, extractor: Extractor | None = None
    ) -> None:
        self.config = config or Config()
        self.camera = camera.to(torch.float64)
        if extractor is None and self.config.features.kind != "simulated":
            extractor = image_extractor(self.config, self.camera.params.device)
        self.extractor = extractor  # None: `run` makes simulated features from the true poses of the sequence
        self.clock = Stopwatch()
        self.reset()

    def reset(self) -> None:
        """Forget everything and wait for a new start."""
        self.initializer = Initializer(self.camera, self.config)
        self._forget_map()

    def _forget_map(self) -> None:
        self.state = State.INITIALIZING
        self.world = World.empty(0, self.camera.params)
        self.tracker = Tracker(self.camera, self.config)
        self.mapper = Mapper(self.camera, self.config, self.clock)

    @torch.no_grad()
    def step(self, frame: Frame) -> StepResult:
        """Process one frame. A frame without a pose is no error: the result says why there is none."""
        if self.extractor is None:
            raise ConfigError(
                "simulated features need true poses: use SLAM.run(sequence), or pass an extractor"
            )
        with self.clock("features"):
            view = View.of(frame, self.extractor(frame), self.camera.params)
        if self.state is State.INITIALIZING:
            return self._initialize(view)
        with self.clock("tracking"):
            tracked = self.tracker.track(self.world, view)
        if tracked is None:
            return self._lose(view)
        self.state = State.TRACKING
        why = why_keyframe(view, tracked, self.world, self.config.keyframes)
        if why:
            self.tracker.follow(self.world, self.mapper.insert(self.map, view, tracked))
        self.history.add(view, tracked, self.world.track.T_cr, self.world.track.reference)
        return self._result(view, why, self.world.T_cw, tracked, is_keyframe=bool(why))

    @property
    def map(self) -> Map:
        return self.world.map

    @property
    def history(self) -> History:
        return self.world.history

    def run(self, sequence: Sequence, progress: Callable[[StepResult], None] | None = None) -> Run:
        """Process a sequence: bad frames are skipped and counted, the whole map is adjusted at the end."""
        return run_sequence(self, sequence, progress)

    def trajectory(self) -> Trajectory:
        """Every posed frame, by the map as it is now."""
        return self.history.trajectory(self.map)

    def _initialize(self, view: View) -> StepResult:
        """Try to start a map, and believe it if it explains the frames that were seen on the way to it."""
        with self.clock("initialization"):
            start, reason = self.initializer.step(view)
            if start is not None:
                reason = self._start(start)
        if reason:
            return self._result(view, reason)
        self.state = State.TRACKING
        return self._result(view, "started the map", self.world.T_cw, is_keyframe=True)

    def _start(self, start: Start) -> str:
        """Make the first map; why it is not believed after all, or nothing."""
        first, second = self.mapper.start(self.map, start)
        self.tracker.follow(self.world, first)
        explained = [self._explain(earlier) for earlier in self.initializer.views]
        self.tracker.follow(self.world, second)
        if sum(explained) >= self.config.initialization.min_explained * len(explained):
            return ""
        self._forget_map()
        return f"bad start: it explains {sum(explained)} of {len(explained)} frames"

    def _explain(self, view: View) -> bool:
        """Pose a frame that was seen before there was a map; whether most of its matches agree with the map."""
        tracked = self.tracker.track(self.world, view)
        if tracked is None:
            return False
        self.history.add(view, tracked, self.world.track.T_cr, self.world.track.reference)
        return tracked.inliers > 0.5 * tracked.matches

    def _lose(self, view: View) -> StepResult:
        """Stay lost and try again with the next frame; a map that is lost right after its start is given up."""
        self.state = State.LOST
        reason = "lost"
        if self.map.num_keyframes < MIN_KEYFRAMES:
            self.reset()
            reason = "lost right after the start: starting anew"
        return self._result(view, reason)

    def _result(
        self,
        view: View,
        reason: str,
        T_cw: Tensor | None = None,
        tracked: Tracked | None = None,
        is_keyframe: bool = False,
    ) -> StepResult:
        return StepResult(
            index=view.index,
            timestamp=view.timestamp,
            state=self.state,
            T_cw=T_cw,
            is_keyframe=is_keyframe,
            matches=tracked.matches if tracked else 0,
            inliers=tracked.inliers if tracked else 0,
            reason=reason,
            stage_ms=self.clock.take(),
        )
