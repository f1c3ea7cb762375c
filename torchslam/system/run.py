"""Process a whole sequence, and the result of it."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch

from torchslam.config import Config
from torchslam.data.sequence import EndOfSequence, Frames, Sequence
from torchslam.errors import FrameError, InitializationError, TorchslamError
from torchslam.geometry import Camera, SensorModel, SharedCamera, se3_inverse
from torchslam.geometry.camera_measurement import CameraMeasurement, with_radial_terms
from torchslam.geometry.gating import passes_gate
from torchslam.geometry.rolling_shutter import Readout
from torchslam.loop_closing.loop_closer import LoopCloser
from torchslam.loop_closing.loop_detector import LoopClosureRecord
from torchslam.map.atlas import Atlas, Submap, main_submap
from torchslam.map.map import Map
from torchslam.map.posed_frames import PosedFrames
from torchslam.map.unit import MetricUnit
from torchslam.mapping.local_bundle import adjust_all, noise_variance, squared_errors
from torchslam.optim import GRAPH_OPTIONS, Progress, SolverOptions, pose_covariance
from torchslam.optim.rolling_shutter import RollingShutter
from torchslam.optim.run_graph import (
    POSE_ITERATIONS,
    GraphSolution,
    RunGraph,
    concatenate_graphs,
    keyframe_problem,
    solve_graph,
)
from torchslam.optim.sensor_estimate import SensorPrior, estimate_sensor, graph_evidence
from torchslam.system.front_end import source
from torchslam.system.online_camera import CameraChange, OnlineCamera, given_readout
from torchslam.system.session import Session
from torchslam.types import Frame, FrameFeatures, Reason, State, StepResult, Trajectory


class _System(Protocol):
    """The part of `torchslam.system.slam.SLAM` that a run needs."""

    camera: Camera
    shared_camera: SharedCamera
    online_camera: OnlineCamera
    config: Config
    session: Session
    loop_closer: LoopCloser
    last_frame: tuple[int, float] | None

    def step(self, frame: Frame) -> StepResult:
        """Process one frame."""

    def finalize(self) -> None:
        """End the session."""

    def adopt_camera(self, camera: Camera) -> None:
        """Save the maps with a camera that was found."""


@dataclass(frozen=True)
class Run:
    """The result of a run.

    Attributes:
        submaps: submaps in the order of their creation; usually one.
        sensor: camera, shutter and noise as the final adjustment found them; the given camera where there is none, or
            where that is exact. With a readout, the final poses are corrected for a rolling shutter.
        config: the configuration.
        results: one result per processed frame.
        skipped: messages about the frames that could not be read.
        interrupted: True if the user stopped the run.
        failure: message that says why no frame has a pose; empty if some have one.
        loop_closures: closed loops and merges of submaps.
        session: number of the run among those over the same map; frames and trajectories are those of this session.
        sessions: number of sessions of the map, without those that only localized.
        given: the given camera with its error, if the final adjustment changed it.
        calibration: `camera` with its error after the final adjustment.
        camera_changes: cameras that the map took over while the run went on.
        shutter: what the residuals say of it; None where that was not tested.
        unmeasured: one line for each source of meters that said nothing of the main submap.
    """

    submaps: tuple[Submap, ...]
    sensor: SensorModel
    config: Config
    results: list[StepResult]
    skipped: list[str]
    interrupted: bool
    failure: str
    loop_closures: tuple[LoopClosureRecord, ...] = ()
    session: int = 0
    sessions: int = 1
    given: CameraMeasurement | None = None
    calibration: CameraMeasurement | None = None
    camera_changes: tuple[CameraChange, ...] = ()
    shutter: RollingShutter | None = None
    unmeasured: tuple[str, ...] = ()

    @property
    def metric(self) -> MetricUnit | None:
        """How well the unit of the main submap is known to be a meter; None where it is arbitrary."""
        return None if self.main is None else self.main.metric

    @property
    def main(self) -> Submap | None:
        """The submap in which most frames of the run are posed; None where there is no map."""
        return main_submap(self.submaps, self.session)

    @property
    def map(self) -> Map:
        """The map of the main submap; empty where there is none."""
        return Map() if self.main is None else self.main.map

    @property
    def posed_frames(self) -> PosedFrames:
        """Poses and observations of the frames of the main submap."""
        return PosedFrames() if self.main is None else self.main.posed_frames

    @property
    def trajectory(self) -> Trajectory:
        """The final pose of every posed frame of the main submap."""
        return Trajectory.empty() if self.main is None else self.main.trajectory(self.session)

    @property
    def keyframes(self) -> Trajectory:
        """The final poses of the keyframes of the main submap."""
        return self.map.keyframe_trajectory(self.session)

    @property
    def online(self) -> Trajectory:
        """The poses that were returned frame by frame in the main submap."""
        return Trajectory.empty() if self.main is None else self._given_in(self.main.number)

    @property
    def online_parts(self) -> list[Trajectory]:
        """The online poses of the main submap, and of each submap that was merged into it, each in its own frame.

        Poses in submaps that were discarded, or that are still separate, are left out.
        """
        if self.main is None:
            return []
        numbers = [self.main.number]
        joined = {frozenset((closure.submap, closure.matched_submap)) for closure in self.loop_closures}
        for number in numbers:
            numbers += sorted(set[int]().union(*(pair for pair in joined if number in pair)) - set(numbers))
        return [part for number in numbers if len(part := self._given_in(number))]

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""
        return self.sensor.camera

    @property
    def readout(self) -> Readout | None:
        """The readout of a rolling shutter, given or found; None: a global shutter."""
        return self.sensor.readout

    def at_middle_row(self, views: list[FrameFeatures]) -> list[FrameFeatures]:
        """Views of frames of the main submap with the keypoints of a global shutter; others as they are."""
        if self.main is None:
            return views
        return self.posed_frames.at_middle_row(views, self.map, self.sensor)

    def _given_in(self, number: int) -> Trajectory:
        """The poses that were returned in the submap of a number."""
        given = [result for result in self.results if result.T_cw is not None and result.submap == number]
        if not given:
            return Trajectory.empty()
        T_cw = torch.stack([result.T_cw for result in given if result.T_cw is not None])
        times = torch.tensor([result.timestamp for result in given], dtype=torch.float64, device="cpu")
        return Trajectory(times, se3_inverse(T_cw))

    @property
    def graph(self) -> RunGraph:
        """All observations as one differentiable problem: `torchslam.solve_graph(run.graph)` gives all poses.

        Where there are several submaps, `graph.submap` says whose poses can be compared with each other.

        Raises:
            InitializationError: if there is no map.
        """
        if not self.submaps:
            raise InitializationError(self.failure)
        return concatenate_graphs([self._graph_of(submap) for submap in self.submaps])

    def _graph_of(self, submap: Submap) -> RunGraph:
        return submap.posed_frames.graph(submap.map, self.sensor, submap.number, self.given)


@dataclass
class RunProgress:
    """How far a run has come.

    Attributes:
        next: index of the next frame.
        results: one result per processed frame.
        skipped: messages about the frames that could not be read.
    """

    next: int = 0
    results: list[StepResult] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)


def run_sequence(
    slam: _System,
    sequence: Sequence,
    progress: Callable[[StepResult], None] | None = None,
    so_far: RunProgress | None = None,
    adjusting: Progress | None = None,
    frames: Frames | None = None,
) -> Run:
    """Feed every frame of a sequence to the system.

    A frame that cannot be read, or that does not fit the camera or the order of time, is skipped with a warning and
    counted; an interrupt ends the run, or its final adjustment, and keeps what there is.

    Args:
        slam: the system.
        sequence: the sequence.
        progress: called after every frame.
        so_far: progress to resume from; it is updated after every frame.
        adjusting: called before each iteration of the final adjustments with its number and the maximum.
        frames: source of the frames; None: the sequence.

    Raises:
        TorchslamError: if the system has processed frames that are missing in `so_far`.
    """
    so_far = RunProgress() if so_far is None else so_far
    interrupted = False
    try:
        run_frames(slam, sequence, so_far, progress, frames)
    except KeyboardInterrupt:
        interrupted = True
    return finish(slam, so_far.results, so_far.skipped, interrupted, adjusting)


def run_frames(
    slam: _System,
    sequence: Sequence,
    so_far: RunProgress,
    progress: Callable[[StepResult], None] | None = None,
    frames: Frames | None = None,
    until_lost: bool = False,
) -> bool:
    """Feed the frames of a sequence to the system, without an end of the session: the run can go on.

    Args:
        slam: the system.
        sequence: the sequence.
        so_far: progress to go on from; it is updated after every frame.
        progress: as in `run_sequence`.
        frames: as in `run_sequence`.
        until_lost: whether to stop after a frame in which tracking was lost.

    Returns:
        Whether all frames were processed.

    Raises:
        KeyboardInterrupt: `progress` raised it; the run can go on.
        TorchslamError: if the system has processed frames that are missing in `so_far`.
    """
    if slam.last_frame is not None and not so_far.next:
        raise TorchslamError(
            "this SLAM has processed frames already: call reset() to begin anew, "
            "or save() its submaps and SLAM.load() them to go on there"
        )
    sequence = source(sequence, slam.config, slam.camera)
    frames = sequence if frames is None else frames
    is_lost = any(result.state is State.LOST for result in so_far.results)
    for index in sequence.indices(so_far.next):
        if until_lost and is_lost:
            return False
        try:
            so_far.results.append(slam.step(frames[index]))
        except EndOfSequence:
            break
        except FrameError as error:
            warnings.warn(f"skipped a frame: {error}", stacklevel=3)
            so_far.skipped.append(str(error))
            so_far.next = index + 1
            continue
        so_far.next = index + 1
        is_lost |= so_far.results[-1].state is State.LOST
        if progress is not None:
            progress(so_far.results[-1])
    return True


def finish(
    slam: _System,
    results: list[StepResult],
    skipped: list[str],
    interrupted: bool,
    adjusting: Progress | None = None,
) -> Run:
    """Adjust all maps if so configured, and gather what the run leaves behind; `adjusting` as in `run_sequence`."""
    with torch.inference_mode():
        slam.finalize()
    final = FinalAdjustment(slam.shared_camera.model, slam.config, slam.online_camera.given)
    try:
        if slam.session.mapping:
            final.adjust(slam.session.atlas, slam.session.number, adjusting)
    except KeyboardInterrupt:
        interrupted = True
    slam.adopt_camera(final.sensor.camera)
    return Run(
        tuple(slam.session.atlas),
        final.sensor,
        slam.config,
        results,
        skipped,
        interrupted,
        failure_message(slam, results, skipped),
        tuple(slam.loop_closer.loop_closures),
        slam.session.number,
        slam.session.count,
        final.given,
        final.calibration,
        tuple(slam.online_camera.changes),
        final.shutter,
    )


FINAL_CHI_SQUARE = 1.5**2
"""Squared error, in units of the noise that the extractor states, from which on an observation leaves the final map.
Where poses are right keypoints are more exact than stated: the median squared error is .07 to .39 of it on five
recordings. From 1.2 to 2.4 deviations, their ATE changes by up to 6 % without order; with 1.7 and more, over 2 % of
redkitchen's errors stay above 4 px."""
FINAL = GRAPH_OPTIONS.replace(iterations=POSE_ITERATIONS, backward="detached")
ROUGH = FINAL.replace(tolerance=1e-5)
"""Before outliers leave: they move the minimum by more than the tolerance. With the tolerances of the solvers kitti07
takes 1.2 times as long."""
SETTLED = FINAL.replace(tolerance=1e-8)
"""For the map of a whole recording: its loops and far points make Gauss-Newton slow, 20 of 30 iterations on courthouse
lower the cost from 1e-8 to 1e-10 of it, by a hundredth of what tells two poses apart."""
MOST_JOINT_FRAMES = 600
"""Keyframes of which the joint covariance is computed for their own ones: its four matrices take .4 GB then, and grow
with the square. Maps of more keep the covariances of the normal matrix. Tried with 4 to 152 keyframes."""
LEAST_RATIO = 0.3
"""Least share of the observations of a frame that are near; else its pose may be wrong, and it keeps them all."""


class FinalAdjustment:
    """The adjustment of all maps at the end of a run, over keyframes, points, frames in between and the camera.

    Attributes:
        sensor: of the adjusted maps.
        given: the given camera with its error, along the directions that the images agree on, as the final adjustment
            has it as its prior; None until then, and where the camera is exact.
        calibration: the camera of `sensor` with its error; None as `given`.
        shutter: the residuals as functions of the readout; None where that was not tested.
    """

    def __init__(self, sensor: SensorModel, config: Config, measured: CameraMeasurement | None) -> None:
        """Create the adjustment.

        Args:
            sensor: of the maps as they are.
            config: the configuration.
            measured: the given camera with its error; None if it is exact.
        """
        self.sensor, self.is_wanted = sensor, not config.paper.unrefined
        self.prior = SensorPrior(measured, given_readout(config.camera))
        self.given: CameraMeasurement | None = None
        self.calibration: CameraMeasurement | None = None
        self.shutter: RollingShutter | None = None

    def adjust(
        self, atlas: Atlas, session: int, progress: Progress | None = None, settled: bool = False
    ) -> None:
        """Adjust all submaps, unless they stay unrefined. The main one determines the camera; the others follow.

        Args:
            atlas: the submaps.
            session: the session whose main submap determines the camera.
            progress: called before each iteration; if it raises, what was adjusted so far stays.
            settled: keyframes and points are at a minimum already, and what is far from it has been removed.
        """
        main = atlas.main(session)
        if main is None or not self.is_wanted:
            return
        self._adjust(main, self.prior.camera, progress, settled, is_main=True)
        for submap in atlas:
            if submap is not main:
                self._adjust(submap, None, progress, settled)

    def _adjust(
        self,
        submap: Submap,
        given: CameraMeasurement | None,
        progress: Progress | None,
        settled: bool,
        is_main: bool = False,
    ) -> None:
        if not settled:
            camera = self.sensor.camera if given is None else with_radial_terms(self.sensor.camera)
            self._use(adjust_all(submap.map, camera, progress, given, ROUGH.tolerance))
        self.given = given or self.given
        submap.posed_frames.remove_outliers(submap.map, self.sensor)
        if not settled:
            self._solve(submap, given, progress, ROUGH)
        # Before outliers leave, since many of them are what a rolling shutter shifts in fast turns.
        if is_main and self._estimate_readout(submap) and not settled:
            self._solve(submap, given, progress, ROUGH)
        submap.correct_keyframes(self.sensor)
        if not settled:
            self._reject(submap)
        if is_main:
            variance = noise_variance(submap.map, self.sensor.camera)
            self.sensor = replace(self.sensor, noise_variance=variance)
        if not settled:
            self._solve(submap, given, progress, ROUGH)
            if is_main and self.sensor.readout is not None:
                self._estimate_readout(submap)
        measured, evidence = given, None
        if given is not None:
            evidence = graph_evidence(self._graph(submap), given)
        if evidence is not None and given is not None:
            estimate = evidence.estimate()
            measured = estimate.measured
            if evidence.is_better_than(given.camera):
                given = estimate.prior
                self._use(given.nearest(self.sensor.camera))
            else:  # it predicts as well, and is held
                self._use(given.camera)
                given = replace(given, directions=given.directions[:, :0])
        solution = self._solve(submap, given, progress, SETTLED if settled else FINAL)
        submap.correct_keyframes(self.sensor)
        if measured is not None:
            self.given, self.calibration = given, replace(measured, camera=self.sensor.camera)
        self._store_covariances(submap, solution)

    def _estimate_readout(self, submap: Submap) -> bool:
        """Estimate the readout; return whether it is another one than before."""
        graph = submap.posed_frames.graph(submap.map, self.sensor)
        found = estimate_sensor(graph, replace(self.prior, camera=None), FINAL, for_shaking=True)
        self.sensor = replace(self.sensor, readout=found.sensor.readout)
        self.shutter = found.shutter
        return found.has_other_readout

    def _reject(self, submap: Submap) -> None:
        """Remove observations that are far from their points.

        Poses are right now where they can be, so that what is still far is wrong. The rounds of a settled map have
        removed that already, and what holds a weak link is often less exact than the rest.
        """
        seen = submap.map.observations()
        wrong = ~passes_gate(squared_errors(submap.map, seen, self.sensor.camera), FINAL_CHI_SQUARE)
        submap.map.remove_masked_observations(seen, wrong)
        submap.posed_frames.remove_outliers(submap.map, self.sensor, FINAL_CHI_SQUARE, LEAST_RATIO)

    def _use(self, camera: Camera) -> None:
        self.sensor = replace(self.sensor, camera=camera)

    def _store_covariances(self, submap: Submap, solution: GraphSolution) -> None:
        """Store how exact keyframes and points are; the error of the camera is one of the keyframes."""
        graph = self._graph(submap)
        errors = None if self.calibration is None else self.calibration.directions
        keyframes, *_, problem = keyframe_problem(graph, 0)
        (bundle,) = solution.keyframes
        found = bundle.covariance()
        if len(keyframes) <= MOST_JOINT_FRAMES:
            joint = pose_covariance(problem, FINAL, errors).unflatten(0, (-1, 6)).unflatten(-1, (-1, 6))
            found = found._replace(frames=joint.diagonal(dim1=0, dim2=2).movedim(-1, 0))
        submap.map.set_covariances(keyframes, graph.point_ids, found)

    def _graph(self, submap: Submap) -> RunGraph:
        """The graph of a submap, with the keypoints of a global shutter as its poses are now."""
        return submap.posed_frames.graph(submap.map, self.sensor).global_shutter()

    def _solve(
        self,
        submap: Submap,
        given: CameraMeasurement | None,
        progress: Progress | None,
        options: SolverOptions,
    ) -> GraphSolution:
        """Solve the graph of a submap, and use the camera and the poses of the solution.

        A rough solution is that of the keypoints as the poses before correct them.
        """
        graph = submap.posed_frames.graph(submap.map, self.sensor, calibration=given)
        graph = graph.global_shutter() if options is ROUGH else graph
        solution = solve_graph(graph, progress=progress, options=options)
        submap.posed_frames.apply_solution(solution, graph, submap.map)
        self._use(solution.camera)
        return solution


def failure_message(slam: _System, results: list[StepResult], skipped: list[str]) -> str:
    """Message that says why no frame of the session has a pose; empty if some have one."""
    if len(slam.session.atlas) == 0:
        return no_map_message(results, skipped)
    if any(submap.posed_frames.count(slam.session.number) for submap in slam.session.atlas):
        return ""
    return f"none of {len(results)} frames was recognized in the map"


def no_map_message(results: list[StepResult], skipped: list[str]) -> str:
    """Message that says how many frames were tried, and the most frequent reason for which no map was initialized."""
    if not results:
        return (
            f"no frame could be read; {len(skipped)} were skipped, the first because {skipped[0]}"
            if skipped
            else "the sequence has no frames"
        )
    attempts = [
        result.reason
        for result in results
        if result.state is State.INITIALIZING and result.reason != Reason.NEW_REFERENCE
    ]
    if not attempts:
        return f"no map was initialized: {len(results)} frames are too few, two with parallax are needed"
    kind, _ = Counter(reason.split(":")[0] for reason in attempts).most_common(1)[0]
    last = next(reason for reason in reversed(attempts) if reason.split(":")[0] == kind)
    return f"no map was initialized in {len(results)} frames: {last}"
