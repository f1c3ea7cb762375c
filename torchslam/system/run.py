"""The result of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from torchslam.config import Config
from torchslam.errors import InitializationError
from torchslam.geometry import Camera, SensorModel, se3_inverse
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.rolling_shutter import Readout
from torchslam.geometry.zoom import Zoom
from torchslam.loop_closing.loop_detector import LoopClosureRecord
from torchslam.map.atlas import Submap, main_submap
from torchslam.map.map import Map
from torchslam.map.posed_frames import PosedFrames
from torchslam.map.unit import MetricUnit
from torchslam.optim.observation_graph import RunGraph, concatenate_graphs
from torchslam.optim.rolling_shutter import RollingShutter
from torchslam.system.online_camera import CameraChange
from torchslam.types import FrameFeatures, StepResult, Trajectory


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
        loop_closures: closed loops and merges of submaps, each with its pose graph and the matches that measured it.
        session: number of the run among those over the same map; frames and trajectories are those of this session.
        sessions: number of sessions of the map, without those that only localized.
        given: the given camera with its error, if the final adjustment changed it.
        calibration: `camera` with its error after the final adjustment.
        camera_changes: cameras that the map took over while the run went on.
        shutter: what the residuals say of it; None where that was not tested.
        unmeasured: one line for each source of meters that said nothing of the main submap.
        zoom: of the recording, undone in all keypoints; None: one focal length.
        read_zoom: the part of it that was undone in the images that the run read.
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
    zoom: Zoom | None = None
    read_zoom: Zoom | None = None

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

    @property
    def found_zoom(self) -> Zoom | None:
        """The zoom of the images that the run read; None: one focal length."""
        return None if self.zoom is None else self.zoom.beyond(self.read_zoom)

    def at_middle_row(self, views: list[FrameFeatures]) -> list[FrameFeatures]:
        """Views without a zoom that was found, those of frames of the main submap with the keypoints of a global
        shutter."""
        if self.main is None:
            return views
        if (zoom := self.found_zoom) is not None:
            views = [_unzoomed(view, zoom, self.camera) for view in views]
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
        mapped = [submap for submap in self.submaps if len(submap.map.points)]
        if not mapped:
            raise InitializationError(self.failure)
        return concatenate_graphs([self._graph_of(submap) for submap in mapped])

    def _graph_of(self, submap: Submap) -> RunGraph:
        return submap.posed_frames.graph(submap.map, self.sensor, submap.number, self.given)


def _unzoomed(view: FrameFeatures, zoom: Zoom, camera: Camera) -> FrameFeatures:
    """A view with a zoom undone in its keypoints."""
    frame = torch.tensor([view.index], device=view.keypoints.device)
    keypoints, detected = (
        zoom.undone(pixels[None], frame, camera)[0] for pixels in (view.keypoints, view.detected)
    )
    return replace(view, keypoints=keypoints, detected=detected)


def joined_zoom(undone: Zoom | None, found: Zoom | None) -> Zoom | None:
    """The zoom of a recording: what was undone in its images, then what was found in those."""
    if undone is None or found is None:
        return undone or found
    return undone.then(found)
