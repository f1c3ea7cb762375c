"""Monocular SLAM, the way of a frame:

frame -> features -> follow the world at hand (track, judge) -> keyframe? -> map -> seen before? -> StepResult
                  -> or find one: a known place, or the beginning of a new world
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchslam.config import Config
from torchslam.data.arrays import image_tensor
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError
from torchslam.geometry import Camera
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.map.atlas import Atlas
from torchslam.map.map import Map
from torchslam.map.posed_frames import PosedFrames
from torchslam.map.submap import Submap
from torchslam.map.validation import why_not_alike
from torchslam.mapping.mapper import Mapper
from torchslam.parallel.workers import with_workers
from torchslam.system.context import ActiveMap, Outcome, SystemContext
from torchslam.system.front_end import FrontEnd, check_order, check_size, image_extractor, source
from torchslam.system.run import Run, run_sequence
from torchslam.system.session import Session
from torchslam.system.state_machine import StateMachine
from torchslam.tracking.dynamic.non_static_filter import NonStaticFilter
from torchslam.tracking.matcher import Matcher, make_matcher, prepare_view
from torchslam.tracking.pose_confirmation import PoseConfirmation
from torchslam.tracking.provisional_map import ProvisionalMap
from torchslam.tracking.tracker import Tracker
from torchslam.types import Frame, FrameFeatures, State, StepResult, Trajectory
from torchslam.utils.timing import Stopwatch


class SLAM:
    """Give it frames one after the other; ask it for the map and the trajectory at any time.

    It works on the device of the camera: SLAM(camera.to("cuda")) runs on the GPU, wherever the images are.
    `save` keeps its worlds in a file; `SLAM.load` goes on in them with a session of its own.

    Settings in pixels are those of images as `features.max_image_pixels` reduces them, and grow with larger ones.

    extractor: front end, from images to `Features`, such as ORB(); the configured one if None. Frames that bring
               features of their own, as those of `front_end.Simulated`, are not shown to it.
    matcher:   who matches two views, see `tracking.matcher.Matcher`; the configured one if None
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        extractor: FrontEnd | None = None,
        matcher: Matcher | None = None,
    ) -> None:
        self.config = config or Config()
        self.camera = camera.to(torch.float64)
        self.extractor = None  # where frames bring their features
        if extractor is not None or self.config.features.kind != "simulated":
            self.extractor = image_extractor(self.config, self.camera.params.device, extractor)
        self.has_own_parts = extractor is not None or matcher is not None  # which other processes do not have
        self.clock = Stopwatch()
        scaled = self.scaled = self.config.for_size(camera.size)  # what is told to the stages
        self.matcher = make_matcher(scaled.matching, matcher)
        self.tracker = Tracker(self.camera, scaled, self.matcher)
        undistorted = self.tracker.localizer.undistorted
        self.mapper = Mapper(self.camera, scaled, self.clock, self.matcher, undistorted)
        self.reset()

    def reset(self) -> None:
        """Forget everything and wait for a new start."""
        self.start_session(Session(self.camera, Atlas(self.camera.params)))

    @classmethod
    def load(
        cls,
        path: str | Path,
        config: Config | None = None,
        extractor: FrontEnd | None = None,
        mapping: bool = True,
        device: torch.device | str = "cpu",
        matcher: Matcher | None = None,
    ) -> SLAM:
        """Go on in the worlds of a file that `save` wrote, with its camera: lost at first, in a session of its own.

        mapping: without it, frames are only localised: no keyframe, point or world is made, none is changed

        Raises ResultsError for a file that is missing, damaged, or without a world to localise in.
        """
        session = Session.load(path, mapping, device)
        slam = cls(session.camera, config, extractor, matcher)
        slam.start_session(session)
        return slam

    def save(self, path: str | Path) -> None:
        """Write worlds and camera to a file, whole or not at all; frames that were only localised are left out."""
        self.session.save(path)

    def start_session(
        self, session: Session, world: Submap | None = None, last_frame: tuple[int, float] | None = None
    ) -> None:
        """Begin a session, lost at first; or go on in one of its worlds, from where the camera was in `last_frame`.

        last_frame: index and timestamp
        """
        self.session, self.worlds, self.mapping = session, session.worlds, session.mapping
        self.last_frame = last_frame
        self.tracker.counts = session.mapping
        self.mapper.adjusting.drop()
        self.memory = LoopCloser(self.camera, self.scaled, self.worlds)
        self.foreign = NonStaticFilter(self.camera, self.scaled)
        state = State.LOST if len(self.worlds) else State.INITIALIZING
        self._here = ActiveMap(world, state if world is None else State.TRACKING)
        self._probation = PoseConfirmation(self.scaled)
        self._states = StateMachine(
            SystemContext(
                camera=self.camera,
                config=self.scaled,
                clock=self.clock,
                matcher=self.matcher,
                tracker=self.tracker,
                mapper=self.mapper,
                session=session,
                memory=self.memory,
                foreign=self.foreign,
                probation=self._probation,
                here=self._here,
            )
        )

    @property
    def world(self) -> Submap | None:
        """The one that is followed; None where none is."""
        return self._here.world

    @property
    def state(self) -> State:
        """After the last frame."""
        return self._here.state

    @property
    def youth(self) -> ProvisionalMap | None:
        """Of the world that is followed, while it is on trial."""
        return self._states.beginning.youth

    @property
    def can_checkpoint(self) -> bool:
        """Whether a world is followed that has proved itself, and no frame is held back."""
        return self.world is not None and self.youth is None and not self._probation

    # --- the way of a frame ----------------------------------------------------------------------------------

    @torch.inference_mode()
    def step(self, frame: Frame) -> StepResult:
        """Process one frame. A frame without a pose is no error: the result says why there is none.

        Raises FrameError for an image of another size and for a frame that does not come after the last one.
        """
        with self.clock.rest("rest"):
            view, outcome = self._process(frame)
        return self._result(view, outcome)

    def _process(self, frame: Frame) -> tuple[FrameFeatures, Outcome]:
        self._check(frame)
        view = self._look(frame)
        return view, self._states.step(view)

    def step_image(self, image: np.ndarray, timestamp: float, channels: str = "rgb") -> StepResult:
        """Process an image of one's own loop: the frame after the last one.

        image: (H, W) or (H, W, C), uint8, or floats in [0, 1]; channels: their order, `channel_orders`

        Raises FrameError for an image that cannot be taken, and as `step` does.
        """
        index = 0 if self.last_frame is None else self.last_frame[0] + 1
        return self.step(Frame(index, float(timestamp), image_tensor(image, channels), f"image {index}"))

    def run(
        self,
        sequence: Sequence,
        progress: Callable[[StepResult], None] | None = None,
        processes: int | None = 1,
    ) -> Run:
        """Process a sequence: bad frames are skipped and counted, the whole map is adjusted at the end.

        processes: how many, this one included; None: what is best, as on the command line. The result is the same.
        """
        sequence = source(sequence, self.config, self.camera)
        with with_workers(sequence, self, processes) as frames:
            return run_sequence(self, sequence, progress, frames=frames)

    def trajectory(self) -> Trajectory:
        """Every posed frame of this session in its main world, by the map as it is now."""
        world = self.worlds.main(self.session.number)
        return Trajectory.empty() if world is None else world.trajectory(self.session.number)

    @property
    def map(self) -> Map:
        """Of the world that is followed, or else of the one with most frames; empty where there is none."""
        world = self.world or self.worlds.main(self.session.number)
        return Map() if world is None else world.map

    @property
    def history(self) -> PosedFrames:
        """The posed frames of the same world as `map`."""
        world = self.world or self.worlds.main(self.session.number)
        return PosedFrames() if world is None else world.history

    @torch.inference_mode()
    def warm_up(self) -> None:
        """Look at an image without anything in it, so that no frame waits for what ORB and torch make on first use."""
        if self.extractor is not None and self.config.features.kind == "orb" and not self.has_own_parts:
            width, height = self.camera.size
            self.extractor(Frame(-1, 0.0, torch.zeros(1, 1, height, width)))

    @torch.inference_mode()
    def precompute_undistortion(self) -> None:
        """Compute the undistortion table of the camera before the first frame is tracked."""
        self.tracker.localizer.undistorted.prepare()

    @torch.inference_mode()
    def confirm_map(self) -> None:
        """Believe a young world as it is: the frames from before its start get their poses."""
        self._states.confirm_map()

    @torch.inference_mode()
    def finalize(self) -> None:
        """The last frame has come: what is held back keeps its pose, uncertain as it is."""
        self._states.finalize()

    def _check(self, frame: Frame) -> None:
        if self.extractor is None and frame.features is None:
            raise ConfigError(
                "simulated features need true poses: use SLAM.run(sequence), or frames that bring features"
            )
        check_order(frame, self.last_frame)
        is_whole = frame.image.numel() > 0 or frame.features is None  # else only its features came
        if is_whole:
            check_size(frame, self.camera)

    def _look(self, frame: Frame) -> FrameFeatures:
        with self.clock("features"):
            features = frame.features
            if features is None:
                assert self.extractor is not None  # as `_check` saw to
                features = self.extractor(frame)
            view = prepare_view(FrameFeatures.of(frame, features, self.camera.params), frame, self.matcher)
            self.seen = replace(view, session=self.session.number)
            if self.last_frame is None:
                self._check_kind(self.seen)
            self.last_frame = frame.index, frame.timestamp
            return self.foreign.clear_of(self.seen)

    def _check_kind(self, view: FrameFeatures) -> None:
        """Raises ConfigError where the front end is another one than that of the worlds."""
        for world in self.worlds:
            wrong = why_not_alike(world.map, view, to_map=self.mapping)
            if wrong:
                raise ConfigError(f"the map was made with another front end: {wrong}")

    @torch.inference_mode(False)  # poses that leave may become part of a graph
    def _result(self, view: FrameFeatures, outcome: Outcome) -> StepResult:
        world, tracked = outcome.world, outcome.tracked
        return StepResult(
            index=view.index,
            timestamp=view.timestamp,
            state=self.state,
            T_cw=None if world is None else world.T_cw,
            world=None if world is None else world.number,
            covariance=None if tracked is None else tracked.covariance.clone(),
            is_keyframe=outcome.is_keyframe,
            matches=tracked.matches if tracked else 0,
            inliers=tracked.inliers if tracked else 0,
            reason=outcome.reason,
            stage_ms=self.clock.take(),
        )
