"""A whole sequence through the system, and what it leaves behind."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError, FrameError, InitializationError
from torchslam.front_end import simulated_extractor
from torchslam.geometry import Camera, se3_inverse
from torchslam.mapping.local_bundle import adjust_all
from torchslam.solvers.graph import solve
from torchslam.values import State, StepResult, Trajectory
from torchslam.world.history import History, RunGraph
from torchslam.world.map import Map
from torchslam.world.world import World

if TYPE_CHECKING:
    from torchslam.slam import SLAM


@dataclass(frozen=True)
class Run:
    """The result of a run.

    worlds:      what was built, in the order in which it began; mostly one
    results:     one per processed frame
    skipped:     the frames that could not be read, in words
    interrupted: whether the run was stopped by the user
    failure:     why there is no map; empty when there is one
    """

    worlds: tuple[World, ...]
    camera: Camera
    config: Config
    results: list[StepResult]
    skipped: list[str]
    interrupted: bool
    failure: str

    @property
    def main(self) -> World | None:
        """The world in which most frames are posed; None where there is no map."""
        return max(self.worlds, key=lambda world: len(world.history), default=None)

    @property
    def map(self) -> Map:
        """Of the main world; empty where there is none."""
        return Map() if self.main is None else self.main.map

    @property
    def history(self) -> History:
        """Poses and observations of the frames of the main world."""
        return History() if self.main is None else self.main.history

    @property
    def trajectory(self) -> Trajectory:
        """Every posed frame of the main world, after everything that was learned later."""
        return Trajectory.empty() if self.main is None else self.main.trajectory()

    @property
    def keyframes(self) -> Trajectory:
        """The keyframes of the main world alone."""
        return keyframe_trajectory(self.map)

    @property
    def online(self) -> Trajectory:
        """The poses as they were given, frame by frame, in the main world."""
        number = None if self.main is None else self.main.number
        given = [result for result in self.results if result.T_cw is not None and result.world == number]
        if not given:
            return Trajectory.empty()
        T_cw = torch.stack([result.T_cw for result in given if result.T_cw is not None])
        times = torch.tensor([result.timestamp for result in given], dtype=torch.float64)
        return Trajectory(times, se3_inverse(T_cw))

    @property
    def graph(self) -> RunGraph:
        """Everything the run saw, as one differentiable problem: `torchslam.solve(run.graph)` gives its trajectory.

        Raises InitializationError where there is no map.
        """
        if self.failure:
            raise InitializationError(self.failure)
        return self.history.graph(self.map, self.camera)


def run_sequence(slam: SLAM, sequence: Sequence, progress: Callable[[StepResult], None] | None = None) -> Run:
    """Feed every frame of a sequence to the system.

    A frame that cannot be read is skipped with a warning and counted; an interrupt ends the run and keeps what
    there is.
    """
    if slam.extractor is None:
        slam.extractor = simulated_extractor(slam.config, slam.camera, true_poses(sequence))
    results: list[StepResult] = []
    skipped: list[str] = []
    interrupted = False
    try:
        for index in range(len(sequence)):
            try:
                frame = sequence[index]
            except FrameError as error:
                warnings.warn(f"skipped a frame: {error}", stacklevel=2)
                skipped.append(str(error))
                continue
            results.append(slam.step(frame))
            if progress is not None:
                progress(results[-1])
    except KeyboardInterrupt:
        interrupted = True
    return finish(slam, results, skipped, interrupted)


def finish(slam: SLAM, results: list[StepResult], skipped: list[str], interrupted: bool) -> Run:
    """Adjust the whole map if so configured, and gather what the run leaves behind."""
    with torch.no_grad():
        slam.settle()
    for world in slam.worlds:
        if slam.config.bundle.enabled and slam.config.bundle.final:
            adjust_all(world.map, slam.camera, slam.config.bundle)
            graph = world.history.graph(world.map, slam.camera)
            world.history.take(solve(graph, backward="detached"), graph, world.map)
    return Run(
        tuple(slam.worlds),
        slam.camera,
        slam.config,
        results,
        skipped,
        interrupted,
        "" if len(slam.worlds) else why_no_map(results, skipped),
    )


def keyframe_trajectory(slam_map: Map) -> Trajectory:
    """The keyframes, camera to world, in order of time."""
    if slam_map.num_keyframes == 0:
        return Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
    order = torch.argsort(slam_map.keyframes["timestamp"], stable=True)
    return Trajectory(slam_map.keyframes["timestamp"][order], se3_inverse(slam_map.T_cw[order]))


def why_no_map(results: list[StepResult], skipped: list[str]) -> str:
    """One sentence for the user: how many frames were tried, what kept them from starting a map, the last attempt."""
    if not results:
        return (
            f"no frame could be read; {len(skipped)} were skipped, the first because {skipped[0]}"
            if skipped
            else "the sequence has no frames"
        )
    attempts = [
        result.reason
        for result in results
        if result.state is State.INITIALIZING and "reference" not in result.reason
    ]
    if not attempts:
        return f"no map was initialised: {len(results)} frames are too few, two with parallax are needed"
    kind, _ = Counter(reason.split(":")[0] for reason in attempts).most_common(1)[0]
    last = next(reason for reason in reversed(attempts) if reason.split(":")[0] == kind)
    return f"no map was initialised in {len(results)} frames: {last}"


def true_poses(sequence: Sequence) -> torch.Tensor:
    """(F, 4, 4) the true poses, world to camera, of the frames that have one."""
    known = (sequence.pose(index) for index in range(len(sequence)))
    poses = [pose for pose in known if pose is not None]
    if not poses:
        raise ConfigError(
            f"{sequence.name} has no ground truth: simulated features need it; use --features orb"
        )
    return torch.stack(poses).to(torch.float64)
