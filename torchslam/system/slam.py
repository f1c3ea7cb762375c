"""Monocular SLAM: the pipeline of one frame.

check -> extract features -> mask out what does not belong to the static scene, then

- with an active map: track the frame in it -> validate the pose -> keyframe? -> map it -> close loops -> `StepResult`
- without one: relocalize in a known submap, or initialize a new one -> `StepResult`
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Shaped

from torchslam.config import Config
from torchslam.data.formats.image_file import image_tensor
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError
from torchslam.geometry import Camera, SensorModel, SharedCamera
from torchslam.geometry.zoom import Zoom
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.map.atlas import Atlas, Submap
from torchslam.map.map import Map, feature_mismatch, key_of
from torchslam.map.posed_frames import PosedFrames
from torchslam.mapping.mapper import Mapper
from torchslam.metric.options import given_options, sources_of
from torchslam.metric.source import MetricSource
from torchslam.system.frame_log import FrameLog, FrameStatus
from torchslam.system.front_end import (
    Extractor,
    FeatureExtractor,
    check_order,
    check_size,
    checked_extractor,
    image_extractor,
)
from torchslam.system.metric_run import run_in_meters
from torchslam.system.modes import Mode
from torchslam.system.online_camera import OnlineCamera
from torchslam.system.online_run import Observer, OnlineRun
from torchslam.system.run import Run
from torchslam.system.session import ActiveMap, Session, SystemContext
from torchslam.system.state_machine import FrameOutcome, StateMachine
from torchslam.tracking.matcher import make_matcher, prepare_view
from torchslam.tracking.non_static import SceneFilter
from torchslam.tracking.tracker import Tracker
from torchslam.types import (
    Explanation,
    Frame,
    FrameFeatures,
    Matcher,
    MotionModel,
    Reason,
    State,
    StepResult,
    Trajectory,
)
from torchslam.utils.timing import Stopwatch


class SLAM:
    """A monocular SLAM system, which processes one frame after the other.

    It works on the device of the camera: `SLAM(camera.to("cuda"))` runs on the GPU, wherever the images are.
    `save` writes the atlas to a map file; `SLAM.load` starts a further session in it.

    Args:
        camera: The camera of all frames.
        config: The configuration; the default one if None.
        extractor: The extractor, from images to `Features`, such as `ORB()`; the configured one if None. Frames that
            bring their own features, as those of `front_end.Simulated`, are not passed to it.
        matcher: The matcher of two views, see `types.Matcher`, or one of kornia; the configured one if None.
        motion_model: Predicts the pose of a frame, see `types.MotionModel`; the configured one if None.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        extractor: FeatureExtractor | None = None,
        matcher: Matcher | None = None,
        motion_model: MotionModel | None = None,
    ) -> None:
        self.config = config or Config()
        # A copy: parameters may move in place while they learn.
        self.camera = camera.with_params(camera.params.detach().to(torch.float64, copy=True))
        self.extractor = None  # where frames bring their features
        if extractor is not None or self.config.features.kind != "simulated":
            self.extractor = image_extractor(self.config, self.camera.params.device, extractor)
        self.has_custom_components = (
            extractor is not None or matcher is not None
        )  # unknown to worker processes
        self.make_extractor: Callable[[], Extractor] = partial(checked_extractor, self.config, self.camera)
        self.clock = Stopwatch()
        self.matcher = make_matcher(self.config.matching, matcher, camera.size, self.config.features.kind)
        self.shared_camera = SharedCamera(self.camera)
        self.tracker = Tracker(self.shared_camera, self.config, self.matcher, motion_model)
        self.mapper = Mapper(self.shared_camera, self.config, self.clock, self.matcher)
        self.reset()

    def reset(self) -> None:
        """Forget all submaps, and wait for a new initialization."""
        self.zoom: Zoom | None = None  # that is undone in the images of its frames
        self.shared_camera.use(SensorModel(self.camera))
        self.start_session(Session(self.camera, Atlas(self.camera.params)))

    @classmethod
    def load(
        cls,
        path: str | Path,
        config: Config | None = None,
        extractor: FeatureExtractor | None = None,
        mapping: bool = True,
        device: torch.device | str = "cpu",
        matcher: Matcher | None = None,
        motion_model: MotionModel | None = None,
    ) -> SLAM:
        """Start a further session in the atlas of a map file, with its camera; the first frame is relocalized.

        Args:
            path: A file written by `save`.
            config, extractor, matcher, motion_model: As for `SLAM`.
            mapping: If False, frames are only localized: no keyframe, point or submap is created or changed.
            device: Where the system works.

        Raises:
            ResultsError: If the file is missing, damaged, or has no submap to localize in.
        """
        session = Session.load(path, mapping, device)
        slam = cls(session.camera, config, extractor, matcher, motion_model)
        slam.start_session(session)
        return slam

    def save(self, path: str | Path) -> None:
        """Write atlas and camera to a map file, atomically; frames that were only localized are left out."""
        self.session.save(path)

    def start_session(
        self, session: Session, submap: Submap | None = None, last_frame: tuple[int, float] | None = None
    ) -> None:
        """Start a session: lost at first, or tracking in a submap after `last_frame` (index and timestamp)."""
        self.session, self.atlas, self.mapping = session, session.atlas, session.mapping
        self.last_frame = last_frame
        self.last_features: FrameFeatures | None = None  # of the last frame, before masking
        self.last_picture: torch.Tensor | None = None  # of the last frame, if it brought one
        self.tracker = self.tracker.for_session(session.mapping)
        self.mapper.adjustment.drop()
        self.loop_closer = LoopCloser(self.shared_camera, self.config, self.atlas, self.matcher)
        self.scene_filter = SceneFilter(self.shared_camera, self.config)
        self.online_camera = OnlineCamera(self.shared_camera, self.config, self.atlas, self.mapper.adjustment)
        self._context = SystemContext(
            camera=self.shared_camera,
            config=self.config,
            clock=self.clock,
            matcher=self.matcher,
            tracker=self.tracker,
            mapper=self.mapper,
            session=session,
            loop_closer=self.loop_closer,
            scene_filter=self.scene_filter,
            online_camera=self.online_camera,
            log=FrameLog(),
            active_map=ActiveMap(submap),
        )
        self._state_machine = StateMachine(self._context)

    @property
    def submap(self) -> Submap | None:
        """The active submap; None while there is none."""
        return self._context.active_map.submap

    @property
    def mode(self) -> Mode:
        """What the system does with the next frame."""
        return self._context.mode

    @property
    def state(self) -> State:
        """State after the last frame."""
        return self.mode.state

    @property
    def can_checkpoint(self) -> bool:
        """Whether the active submap is confirmed, no frame is held back, and the whole map is not being adjusted."""
        return self.mode is Mode.TRACKING and not self.mapper.adjustment.is_whole

    # --- pipeline --------------------------------------------------------------------------------------------

    @torch.inference_mode()
    def step(self, frame: Frame) -> StepResult:
        """Process one frame. A frame without a pose is no error: the result says why there is none.

        Raises:
            FrameError: If the image has another size than the camera, values other than gray in [0, 1], or the frame
                does not come after the last one.

        An exception of an extractor or a matcher of one's own leaves the state of before, unless the frame has its
        pose already; then it can be tried again.
        """
        last = self.last_frame, self.last_features
        try:
            return self._step(frame)
        except BaseException:
            if not self._has_pose(frame):
                self.last_frame, self.last_features = last
            raise

    def _has_pose(self, frame: Frame) -> bool:
        """Whether a frame is among the posed ones, or among those that are held back."""
        if self._context.log.status(frame.index) is FrameStatus.HELD:
            return True
        key = int(
            key_of(torch.tensor(self.session.number, device="cpu"), torch.tensor(frame.index, device="cpu"))
        )
        return any(
            len(each.posed_frames) > 0 and key in each.posed_frames.keys.tolist() for each in self.atlas
        )

    def _step(self, frame: Frame) -> StepResult:
        with self.clock.rest("rest"):
            self._check(frame)
            with self.clock("features"):
                filtered = self.scene_filter.mask_out(self._extract(frame))
            outcome = self._state_machine.step(filtered)
        return self._result(filtered.view, outcome)

    def step_image(
        self, image: Shaped[np.ndarray, "H W *channels"], timestamp: float, channels: str = "rgb"
    ) -> StepResult:
        """Process an image as the frame after the last one.

        Args:
            image: uint8, or floats in [0, 1].
            timestamp: Seconds.
            channels: Order of the channels, one of `channel_orders`.

        Raises:
            FrameError: If the image is of another type or shape, and as `step` does.
        """
        index = 0 if self.last_frame is None else self.last_frame[0] + 1
        return self.step(Frame(index, float(timestamp), image_tensor(image, channels), f"image {index}"))

    def run(
        self,
        sequence: Sequence,
        progress: Callable[[StepResult], None] | None = None,
        processes: int | None = 1,
        measurements: Iterable[MetricSource] = (),
    ) -> Run:
        """Process a sequence: bad frames are skipped and counted, the whole map is adjusted at the end.

        Args:
            sequence: The frames.
            progress: Called after every frame.
            processes: Number of processes, this one included; None: the best number. The result is the same.
            measurements: Sources of meters, beside those of `config.metric` and those that the sequence brings along.
                The submaps that they measure are in meters afterwards.

        Raises:
            MeasurementError: A measurement from outside is wrong; where a file is, before the first frame.
        """
        measurements = [*sources_of(given_options(self.config.metric, sequence.measurements)), *measurements]
        finished = OnlineRun(self, sequence, None, processes, Observer(progress)).run()
        return run_in_meters(finished, sequence, measurements) if self.mapping else finished

    @torch.inference_mode()
    def warm_up(self) -> None:
        """Extract features of an empty image, so that no frame waits for the initialization of ORB and PyTorch."""
        if (
            self.extractor is not None
            and self.config.features.kind == "orb"
            and not self.has_custom_components
        ):
            width, height = self.camera.size
            self.extractor(
                Frame(-1, 0.0, torch.zeros(1, 1, height, width, dtype=torch.float32, device="cpu"))
            )

    @torch.inference_mode()
    def precompute_undistortion(self) -> None:
        """Compute the undistortion table of the camera before the first frame is tracked."""
        self.shared_camera.undistortion.prepare()

    @torch.inference_mode()
    def confirm_map(self) -> None:
        """Confirm a provisional map as it is, with the frames that are held back and those from before it."""
        self._state_machine.confirm_map()

    @torch.inference_mode()
    def finalize(self) -> None:
        """End the session: frames that are held back keep their poses, uncertain as they are."""
        self._state_machine.finalize()

    def adopt_camera(self, camera: Camera) -> None:
        """Save the maps with the camera that the final adjustment found; frames are tracked with the given one."""
        self.session = replace(self.session, camera=camera)

    # --- results ---------------------------------------------------------------------------------------------

    def trajectory(self) -> Trajectory:
        """Every posed frame of this session in its main submap, by the map as it is now."""
        submap = self.atlas.main(self.session.number)
        return Trajectory.empty() if submap is None else submap.trajectory(self.session.number)

    @property
    def map(self) -> Map:
        """The map of the active submap, or else of the main one; empty without submaps."""
        submap = self.submap or self.atlas.main(self.session.number)
        return Map() if submap is None else submap.map

    @property
    def posed_frames(self) -> PosedFrames:
        """The posed frames of the same submap as `map`."""
        submap = self.submap or self.atlas.main(self.session.number)
        return PosedFrames() if submap is None else submap.posed_frames

    def _check(self, frame: Frame) -> None:
        if self.extractor is None and frame.features is None:
            raise ConfigError(
                "simulated features need true poses: use SLAM.run(sequence), or frames that bring features"
            )
        check_order(frame, self.last_frame)
        has_image = frame.image.numel() > 0 or frame.features is None
        if has_image:
            check_size(frame, self.camera)

    def _extract(self, frame: Frame) -> FrameFeatures:
        """The features of the frame, as the matcher needs them."""
        features = frame.features
        if features is None:
            assert self.extractor is not None  # see `_check`
            features = self.extractor(frame)
        view = prepare_view(FrameFeatures.of(frame, features, self.camera.params), frame, self.matcher)
        self.last_features = view = replace(view, session=self.session.number)
        self.last_picture = frame.picture
        if self.last_frame is None:
            self._check_feature_kind(view)
        self.last_frame = frame.index, frame.timestamp
        return view

    def _check_feature_kind(self, view: FrameFeatures) -> None:
        """Raise ConfigError if the submaps were made with another feature extractor."""
        for submap in self.atlas:
            wrong = feature_mismatch(submap.map, view, to_map=self.mapping)
            if wrong:
                raise ConfigError(f"the map was made with another feature extractor: {wrong}")

    @torch.inference_mode(False)  # poses that leave may become part of a graph
    def _result(self, view: FrameFeatures, outcome: FrameOutcome) -> StepResult:
        submap, estimate = outcome.submap, outcome.estimate
        return StepResult(
            index=view.index,
            timestamp=view.timestamp,
            state=self.state,
            T_cw=None if submap is None else submap.T_cw,
            submap=None if submap is None else submap.number,
            covariance=None if estimate is None else estimate.covariance.clone(),
            is_keyframe=outcome.is_keyframe,
            matches=estimate.matches if estimate else 0,
            inliers=estimate.inliers if estimate else 0,
            reasons=tuple(
                Explanation(each) if isinstance(each, Reason) else Explanation(each.reason, each.values)
                for each in outcome.reasons
            ),
            stage_ms=self.clock.take(),
        )
