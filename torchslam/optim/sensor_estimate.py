"""Estimate the sensor model from the graph of a map: the readout of the shutter and the camera, one after the other.

A rolling shutter bends images as another lens would. So the readout is estimated first, where it is not given, and
keypoints are corrected by it before the camera is. Either is believed only where stretches of the recording predict
each other better with it than with the model in use (`torchslam.optim.model_choice`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from torchslam.geometry import SensorModel
from torchslam.geometry.camera_measurement import CameraMeasurement, with_radial_terms
from torchslam.geometry.rolling_shutter import Readout
from torchslam.optim._core.options import SolverOptions
from torchslam.optim.bundle._api import solve_bundle
from torchslam.optim.camera_evidence import CameraEvidence, camera_evidence
from torchslam.optim.rolling_shutter import MAX_FRAMES, RollingShutter, find_rolling_shutter, readout_by
from torchslam.optim.run_graph import ObservationGraph, RunGraph, camera_prior, keyframe_problem

READOUT_STEPS = 2
"""Gauss-Newton steps of the readout, each with the keypoints corrected by the one before: the second changes it by a
thirtieth."""


@dataclass(frozen=True)
class SensorPrior:
    """What is known of a sensor before its recording.

    Attributes:
        camera: the given camera with its error; None: it is exact.
        readout: given, sought (zero with an error) or excluded (zero, exact).
    """

    camera: CameraMeasurement | None
    readout: Readout


@dataclass(frozen=True)
class SensorEstimate:
    """The sensor by a graph and a prior.

    Attributes:
        sensor: the model to use: what was in use where nothing else predicts better.
        has_other_camera: whether its camera is another one.
        has_other_readout: whether its readout is another one.
        departure: standard errors by which the camera in use was off; 0 where the graph does not determine it.
        shutter: the residuals as functions of the readout; None where that was not tested, or could not be.
    """

    sensor: SensorModel
    has_other_camera: bool
    has_other_readout: bool
    departure: float
    shutter: RollingShutter | None = None

    @property
    def is_change(self) -> bool:
        """Whether the map is to be adjusted by the new model."""
        return self.has_other_camera or self.has_other_readout


def estimate_sensor(
    graph: RunGraph,
    prior: SensorPrior,
    options: SolverOptions,
    readout_frames: int = MAX_FRAMES,
    for_shaking: bool = False,
) -> SensorEstimate:
    """Estimate the readout and the camera of a graph of one submap. Detached.

    Args:
        graph: with the camera and the readout in use.
        prior: what is known without it.
        options: of the adjustment of its keyframes.
        readout_frames: most frames from which the readout is estimated.
        for_shaking: as in `find_rolling_shutter`.
    """
    readout, shutter = graph.readout, None
    if prior.readout.is_sought or prior.readout.is_given:
        for _ in range(READOUT_STEPS):
            shutter = find_rolling_shutter(replace(graph, readout=readout), readout_frames, for_shaking)
            readout = (
                readout_by(shutter, prior.readout) or readout
            )  # the one in use stays where none is better
            if readout is None:
                break
    held = SensorEstimate(
        SensorModel(graph.camera, readout), False, _differs(readout, graph.readout), 0.0, shutter
    )
    # A camera is estimated once the map is adjusted by the readout: before, its poses are those of a bent image.
    if prior.camera is None or (readout is not None and graph.readout is None):
        return held
    evidence = keyframe_evidence(replace(graph, readout=readout), prior.camera, options)
    if evidence is None:
        return held
    estimate = evidence.estimate()
    held = replace(held, departure=estimate.departure_from(graph.camera))
    if not evidence.is_better_than(graph.camera):
        return held
    return replace(held, sensor=replace(held.sensor, camera=estimate.camera), has_other_camera=True)


def _differs(readout: Readout | None, before: Readout | None) -> bool:
    """Whether a readout is another one than before, by more than its error."""
    if readout is None or before is None:
        return readout is not before
    return abs(float(readout.seconds) - float(before.seconds)) > readout.std


def keyframe_evidence(
    graph: ObservationGraph, given: CameraMeasurement, options: SolverOptions
) -> CameraEvidence | None:
    """Adjust keyframes with a free camera and compute what they determine of it.

    Args:
        graph: Of a run; the submap with most keyframes is used.
        given: The given camera with its error, the prior of the adjustment.
        options: Of the adjustment.

    Returns:
        The evidence; None where the keyframes do not determine the camera.
    """
    graph = graph.global_shutter()
    keyframes, *_, problem = keyframe_problem(graph, graph.main_submap)
    problem = replace(problem, camera=with_radial_terms(problem.camera), camera_prior=camera_prior(given))
    found = solve_bundle(problem, free_camera=given.directions, check=False, options=options)
    at = replace(problem, T_cw=found.T_cw, points_w=found.points_w, camera=found.camera, camera_prior=None)
    return camera_evidence(at, given, options, graph.timestamps[keyframes])
