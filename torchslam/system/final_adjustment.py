"""The final adjustment: keyframes, points, frames in between and the sensor model, as a list of steps.

The same for the maps of an online run, for a map of a recording as a whole, and for poses that are refined.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from torchslam.config import Config
from torchslam.geometry import Camera, SensorModel
from torchslam.geometry.camera_measurement import CameraMeasurement, with_radial_terms
from torchslam.geometry.gating import passes_gate
from torchslam.geometry.zoom import Zoom
from torchslam.map.atlas import Atlas, Submap
from torchslam.mapping.local_bundle import adjust_all, noise_variance, squared_errors
from torchslam.optim import GRAPH_OPTIONS, Progress, SolverOptions, pose_covariance
from torchslam.optim.observation_graph import RunGraph, keyframe_problem
from torchslam.optim.rolling_shutter import RollingShutter, ShakingTest
from torchslam.optim.run_graph import GraphSolution, solve_graph
from torchslam.optim.sensor_estimate import SensorPrior, estimate_sensor, graph_evidence
from torchslam.optim.zoom import find_zoom, with_jumps
from torchslam.system.online_camera import given_readout
from torchslam.utils.memory import return_freed_memory

FINAL_CHI_SQUARE = 1.5**2
"""Squared error, in units of the noise that the extractor states, from which on an observation leaves the final map.
Where poses are right keypoints are more exact than stated: the median squared error is .07 to .39 of it on five
recordings. From 1.2 to 2.4 deviations, their ATE changes by up to 6 % without order; with 1.7 and more, over 2 % of
redkitchen's errors stay above 4 px."""
# Poses settle long before the choice of outliers that gradients depend on, which no one asks for here.
FINAL = GRAPH_OPTIONS.replace(iterations=30, backward="detached")
ROUGH = FINAL.replace(tolerance=1e-5)
"""Before outliers leave: they move the minimum by more than the tolerance. With the tolerances of the solvers kitti07
takes 1.2 times as long."""
SETTLED = FINAL.replace(tolerance=1e-6)
"""For the map of a whole recording: its loops and far points make Gauss-Newton slow. 9 of 18 iterations on courthouse
lower the cost from 1e-6 to 1e-8 of it, and move the cameras by 2e-7 of the path."""
MOST_JOINT_FRAMES = 600
"""Keyframes of which the joint covariance is computed for their own ones: its four matrices take .4 GB then, and grow
with the square. Maps of more keep the covariances of the normal matrix. Tried with 4 to 152 keyframes."""
LEAST_RATIO = 0.3
"""Least share of the observations of a frame that are near; else its pose may be wrong, and it keeps them all."""


_Step = Callable[[Submap], None]


class FinalAdjustment:
    """The adjustment of all maps at the end of a run.

    Attributes:
        sensor: of the adjusted maps.
        given: the given camera with its error, along the directions that the images agree on: the prior of the last
            solution. None until then, and where the camera is exact.
        calibration: the camera of `sensor` with its error; None as `given`.
        shutter: the residuals as functions of the readout; None where that was not tested.
        zoom: that was found and undone in the keypoints of the maps; None: one focal length.
    """

    def __init__(
        self,
        sensor: SensorModel,
        config: Config,
        measured: CameraMeasurement | None,
        undone: Zoom | None = None,
    ) -> None:
        """Create the adjustment.

        Args:
            sensor: of the maps as they are.
            config: the configuration.
            measured: the given camera with its error; None if it is exact.
            undone: the zoom that is undone in the images.
        """
        self.has_zoom = undone is not None
        self.sensor, self.is_wanted = sensor, not config.paper.unrefined
        self.prior = SensorPrior(measured, given_readout(config.camera))
        self.given: CameraMeasurement | None = None
        self.calibration: CameraMeasurement | None = None
        self.shutter: RollingShutter | None = None
        self.zoom: Zoom | None = None
        self._progress: Progress | None = None
        self._free: CameraMeasurement | None = (
            None  # prior of the camera in the next solution; None: it is held
        )
        self._measured: CameraMeasurement | None = (
            None  # the estimate that the last solution has its prior from
        )
        self._has_other_readout = False
        self._solution: GraphSolution | None = None

    def adjust(
        self, atlas: Atlas, session: int, progress: Progress | None = None, settled: bool = False
    ) -> None:
        """Adjust all submaps, unless they stay unrefined. The main one determines the sensor; the others follow.

        Args:
            atlas: the submaps.
            session: the session whose main submap determines the sensor.
            progress: called before each iteration; if it raises, what was adjusted so far stays.
            settled: keyframes and points are at a minimum already, and what is far from it has been removed.
        """
        main = atlas.main(session)
        if main is None or not self.is_wanted:
            return
        return_freed_memory()
        self._progress, self._free = progress, self.prior.camera
        for step in self._steps(settled, is_main=True, may_zoom=session == 0):
            step(main)
        self._free = None
        for submap in atlas:
            if submap is not main:
                if self.zoom is not None:
                    submap.undo_zoom(self.zoom, self.sensor.camera)
                for step in self._steps(settled, is_main=False):
                    step(submap)

    def _steps(self, settled: bool, is_main: bool, may_zoom: bool = False) -> list[_Step]:
        """The steps of a submap. The rounds of a settled map have adjusted and rejected already."""
        roughly, exactly = partial(self._solve, options=ROUGH), partial(self._solve, options=FINAL)
        # Where a readout is found, it is estimated once more by better poses.
        test = ShakingTest.ALWAYS if settled else ShakingTest.UNLESS_READ_OUT
        shutter: list[_Step] = [partial(self._estimate_readout, shaking=test)] if is_main else []
        noise: list[_Step] = [self._estimate_noise] if is_main else []
        camera: list[_Step] = [self._choose_camera] if is_main else []
        zoom: list[_Step] = [self._undo_zoom] if may_zoom and self._free is not None else []
        end: list[_Step] = [self._correct, self._state_camera, self._store_covariances]
        if settled:
            exactly = partial(self._solve, options=SETTLED)
            return [self._remove_outliers, *shutter, self._correct, *zoom, *noise, *camera, exactly, *end]
        first: list[_Step] = [self._adjust_keyframes, self._remove_outliers, roughly]
        # The readout before outliers leave, since many of them are what a rolling shutter shifts in fast turns.
        first += [*shutter, partial(self._solve_by_other_readout, options=ROUGH)] if is_main else []
        again: list[_Step] = [self._refine_readout] if is_main else []
        # A zoom as well: many of the outliers are what it moves.
        return [*first, self._correct, *zoom, self._reject, *noise, roughly, *again, *camera, exactly, *end]

    def _adjust_keyframes(self, submap: Submap) -> None:
        """Adjust keyframes and points alone: the frames in between follow them."""
        camera = self.sensor.camera if self._free is None else with_radial_terms(self.sensor.camera)
        self._use(adjust_all(submap.map, camera, self._progress, self._free, ROUGH.tolerance))

    def _remove_outliers(self, submap: Submap) -> None:
        self.given = self._free or self.given
        submap.posed_frames.remove_outliers(submap.map, self.sensor)

    def _correct(self, submap: Submap) -> None:
        submap.correct_keyframes(self.sensor)

    def _estimate_readout(self, submap: Submap, shaking: ShakingTest) -> None:
        graph = submap.posed_frames.graph(submap.map, self.sensor)
        found = estimate_sensor(graph, replace(self.prior, camera=None), FINAL, shaking=shaking)
        self.sensor = replace(self.sensor, readout=found.sensor.readout)
        self.shutter, self._has_other_readout = found.shutter, found.has_other_readout

    def _solve_by_other_readout(self, submap: Submap, options: SolverOptions) -> None:
        if self._has_other_readout:
            self._solve(submap, options)

    def _refine_readout(self, submap: Submap) -> None:
        if self.sensor.readout is not None:
            self._estimate_readout(submap, ShakingTest.ALWAYS)

    def _undo_zoom(self, submap: Submap) -> None:
        """Undo a zoom in the keypoints of all frames, if there is one, and adjust the map to them."""
        assert self._free is not None
        graph = submap.posed_frames.graph(submap.map, self.sensor)
        found = find_zoom(graph, self._free, ROUGH, self.has_zoom)
        if found is None or not found.is_found:
            return
        self.zoom = found.zoom
        submap.undo_zoom(self.zoom, self.sensor.camera)
        self._use(found.camera)
        self._solve(submap, ROUGH)
        whole = with_jumps(self._graph(submap), self.zoom, ROUGH)
        submap.undo_zoom(whole.beyond(self.zoom), self.sensor.camera)
        self.zoom = whole
        self._solve(submap, ROUGH)
        self._correct(submap)

    def _reject(self, submap: Submap) -> None:
        """Remove observations that are far from their points.

        Poses are right now where they can be, so that what is still far is wrong. The rounds of a settled map have
        removed that already, and what holds a weak link is often less exact than the rest.
        """
        seen = submap.map.observations()
        wrong = ~passes_gate(squared_errors(submap.map, seen, self.sensor.camera), FINAL_CHI_SQUARE)
        submap.map.remove_masked_observations(seen, wrong)
        submap.posed_frames.remove_outliers(submap.map, self.sensor, FINAL_CHI_SQUARE, LEAST_RATIO)

    def _estimate_noise(self, submap: Submap) -> None:
        variance = noise_variance(submap.map, self.sensor.camera)
        self.sensor = replace(self.sensor, noise_variance=variance)

    def _choose_camera(self, submap: Submap) -> None:
        """Free the camera in the last solution where it predicts held-out observations better than the given one."""
        given = self._measured = self._free
        evidence = None if given is None else graph_evidence(self._graph(submap), given)
        if given is None or evidence is None:
            return
        estimate = evidence.estimate()
        self._measured = estimate.measured
        if evidence.is_better_than(given.camera):
            self._free = estimate.prior
            self._use(estimate.prior.nearest(self.sensor.camera))
        else:  # it predicts as well, and is held
            self._use(given.camera)
            self._free = replace(given, directions=given.directions[:, :0])

    def _solve(self, submap: Submap, options: SolverOptions) -> None:
        """Solve the graph of a submap, and use the camera and the poses of the solution.

        A rough solution is that of the keypoints as the poses before correct them.
        """
        graph = submap.posed_frames.graph(submap.map, self.sensor, calibration=self._free)
        graph = graph.global_shutter() if options is ROUGH else graph
        self._solution = solve_graph(graph, progress=self._progress, options=options)
        submap.posed_frames.apply_solution(self._solution, graph, submap.map)
        self._use(self._solution.camera)

    def _state_camera(self, submap: Submap) -> None:
        """State the camera of the last solution with its error, where it was free."""
        if self._free is not None and self._measured is not None:
            self.given, self.calibration = self._free, replace(self._measured, camera=self.sensor.camera)

    def _store_covariances(self, submap: Submap) -> None:
        """Store how exact keyframes and points are; the error of the camera is one of the keyframes."""
        assert self._solution is not None
        return_freed_memory()
        graph = self._graph(submap)
        errors = None if self.calibration is None else self.calibration.directions
        keyframes, *_, problem = keyframe_problem(graph, 0)
        (bundle,) = self._solution.keyframes
        found = bundle.covariance()
        if len(keyframes) <= MOST_JOINT_FRAMES:
            joint = pose_covariance(problem, FINAL, errors).unflatten(0, (-1, 6)).unflatten(-1, (-1, 6))
            found = found._replace(frames=joint.diagonal(dim1=0, dim2=2).movedim(-1, 0))
        submap.map.set_covariances(keyframes, graph.point_ids, found)

    def _graph(self, submap: Submap) -> RunGraph:
        """The graph of a submap, with the keypoints of a global shutter as its poses are now."""
        return submap.posed_frames.graph(submap.map, self.sensor).global_shutter()

    def _use(self, camera: Camera) -> None:
        self.sensor = replace(self.sensor, camera=camera)
