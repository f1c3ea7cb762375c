"""Estimate the sensor model from the graph of a map: the readout of the shutter and the camera, one after the other.

A rolling shutter bends images as another lens would. So the readout is estimated first, where it is not given, and
keypoints are corrected by it before the camera is. Either is believed only where stretches of the recording predict
each other better with it than with the model in use (`torchslam.optim.model_choice`).

The formal error of the camera of a bundle adjustment is of independent errors. Those of a point in neighboring frames
are alike, and what no parameter models (a rolling shutter, a lens, a moving car) pulls for seconds in one direction. So
the observations are divided into stretches of time, each with its score of the camera: the slope of its cost, frames
and points eliminated. How much the scores of stretches scatter is the error of the camera, whatever it comes from, as
long as it differs between stretches (the cluster-robust covariance of White, 1980, and Liang and Zeger, 1986). No
stretch is solved again: the whole is one factorization and sums.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchslam.geometry import SensorModel
from torchslam.geometry.camera import Camera
from torchslam.geometry.camera_measurement import CameraMeasurement, with_radial_terms
from torchslam.geometry.precision import full_precision
from torchslam.geometry.rolling_shutter import Readout
from torchslam.optim._core.levenberg_marquardt import GRAPH_OPTIONS, SolverOptions
from torchslam.optim.bundle._problem import BundleProblem
from torchslam.optim.bundle._scores import camera_scores
from torchslam.optim.bundle._solve import solve_bundle
from torchslam.optim.model_choice import Gain
from torchslam.optim.observation_graph import ObservationGraph, RunGraph, camera_prior, keyframe_problem
from torchslam.optim.rolling_shutter import (
    MAX_FRAMES,
    RollingShutter,
    ShakingTest,
    find_rolling_shutter,
    readout_by,
)

MAX_STRETCHES, STRETCH_FRAMES = 10, 3
"""Stretches of a recording, and the least frames of one. By 4 to 20 stretches of seven recordings the errors of the
focal length are the same within a third."""
USUAL_FACTOR, USUAL_STRETCHES = 4.0, 1.5
"""By which the scatter of stretches exceeds the formal error before any is seen, and as how many stretches that counts:
a few stretches may agree by chance. With a factor of 2, cameras of windows of 6 to 30 keyframes were off by up to four
stated errors (20 rendered sequences, 25 parts of recordings), with 4 by up to 2.2."""
WORTH = 2.0
"""By how many variances of an observation a free parameter may raise the cost of stretches left out: half of one is by
chance, and a parameter that is held keeps its whole given error. With 1 three of 24 right cameras were held; with 2
one of them is, and a recording of four keyframes whose halves contradict each other."""
CALIBRATED_STD = 0.03
"""Relative standard deviation of a focal length up to which it counts as given; those by image pairs have 0.05."""
CONTRADICTED = 2.5
"""Factor on the error of a given camera that the images contradict: a calibration is either exact, and kept, or off by
more than stated. Errors of published ones go up to 5 %, 2.5 times the default of 2 %."""


@dataclass(frozen=True)
class CameraEstimate:
    """A camera with its error, by what was known of it and what the images determine.

    Attributes:
        measured: the camera and its error, by prior and evidence. Parameters that were held have the error that they
            were given with, and what follows from it for the others.
        prior: the given camera, along the directions that are free, with the variance of observations that stretches
            show: a bundle adjustment with it as its prior ends at `camera`.
        step: along these directions by the images alone, in standard deviations of the given camera.
        covariance: of the step.
    """

    measured: CameraMeasurement
    prior: CameraMeasurement
    step: Float[Tensor, " f"]
    covariance: Float[Tensor, "f f"]

    @property
    def camera(self) -> Camera:
        """The mean of prior and evidence."""
        return self.measured.camera

    @property
    def departure(self) -> float:
        """Departure of the estimate from the given camera in standard errors; see `departure_from`."""
        return self.departure_from(self.prior.camera)

    def departure_from(self, camera: Camera) -> float:
        """Return the departure of the estimate from a camera in standard errors; 0 if nothing is free.

        It is the length of the whitened step, which chance alone makes 2.4 and 2.8 in 5 % of all cases with two and
        three parameters.
        """
        if len(self.step) == 0:
            return 0.0
        off = with_radial_terms(camera).params - self.prior.camera.params
        step = self.step - torch.linalg.pinv(self.prior.directions) @ off
        return float((step @ torch.linalg.solve(self.covariance, step)).sqrt())


@dataclass(frozen=True)
class CameraEvidence:
    """The costs of stretches of a recording as functions of the camera, to second order.

    Along the directions of a given camera, in its standard deviations, a stretch costs
    -score^T step + step^T information step / 2.

    Attributes:
        given: the camera with its error.
        scores: of each stretch, at the given camera.
        information: of each stretch.
        variance: variance of an observation by the residuals, in units of the stated one.
        is_calibration: whether `given` is a calibration, with `CONTRADICTED` times its error, not a guess.
    """

    given: CameraMeasurement
    scores: Float[Tensor, "G n"]
    information: Float[Tensor, "G n n"]
    variance: float
    is_calibration: bool = False

    def is_better_than(self, current: Camera) -> bool:
        """Whether the camera of `estimate` is to replace the one in use."""
        params = with_radial_terms(current).params
        is_given = self.is_calibration and torch.equal(params, self.given.camera.params)
        return self.gain(current).is_worth(is_given)

    def gain(self, current: Camera) -> Gain:
        """How much better stretches are predicted by the camera that all others find than by the one in use.

        Log likelihoods, by the variance that the residuals show; along the directions that stretches agree on.
        """
        free = self.agreed
        off = with_radial_terms(current).params - self.given.camera.params
        now = (torch.linalg.pinv(self.given.directions) @ off)[None].expand_as(self.scores)
        return Gain.of_stretches((self._lowered(free) - self._lower_by(now, len(now[0]))) / self.variance)

    def estimate(self, free: int | None = None) -> CameraEstimate:
        """Combine the images with what was known; `free` leading directions are free, `agreed` if None."""
        free = self.agreed if free is None else free
        scores, whole = self.scores.sum(0), self.information.sum(0)
        own = whole[:free, :free]
        scatter = self._scatter(free)
        inverse = torch.linalg.inv(own)
        root = torch.linalg.cholesky(inverse)
        factor = float(scatter.diagonal().mean()) if free else self.variance
        eye = torch.eye(len(whole), dtype=whole.dtype, device=whole.device)
        gain = torch.linalg.inv(own + factor * eye[:free, :free])
        mean = gain @ scores[:free]
        # Errors of the observations, of the prior, and of the held parameters, which the free ones follow.
        follows = -gain @ whole[:free, free:]
        L = torch.linalg.cholesky(own)
        own_errors = gain @ (L @ scatter @ L.mT + factor**2 * eye[:free, :free]) @ gain
        covariance = eye.clone()
        covariance[:free, :free] = own_errors + follows @ follows.mT
        covariance[:free, free:], covariance[free:, :free] = follows, follows.mT
        given, directions = self.given, self.given.directions[:, :free]
        measured = given.with_error(
            given.camera.with_params(given.camera.params + directions @ mean), covariance
        )
        prior = CameraMeasurement(given.camera, directions, factor)
        return CameraEstimate(measured, prior, inverse @ scores[:free], root @ scatter @ root.mT)

    @cached_property
    def agreed(self) -> int:
        """How many of the leading directions stretches agree on.

        The estimate of the other stretches must lower the cost of a stretch, in the sum over all. A direction in which
        the given camera is exact raises it by about half the variance of an observation, by chance; one that raises it
        by more than `WORTH` of them is better held at what was given.
        """
        variance = USUAL_FACTOR**2 * self.variance
        counts = range(1, self.scores.shape[1] + 1)
        gains = [0.0, *(float(self._lowered(count).sum()) for count in counts)]
        return max(range(len(gains)), key=lambda count: gains[count] + WORTH * count * variance)

    def _lowered(self, free: int) -> Float[Tensor, " G"]:
        """By how much each stretch's cost is lower at the camera that all others find."""
        scores, information = self.scores[:, :free], self.information[:, :free, :free]
        prior = self._scatter(self.scores.shape[1]).diagonal().mean()
        prior = prior * torch.eye(free, dtype=scores.dtype, device=scores.device)
        others = information.sum(0) - information + prior
        step = torch.linalg.solve(others, scores.sum(0) - scores)
        return self._lower_by(step, free)

    def _lower_by(self, step: Float[Tensor, "G f"], free: int) -> Float[Tensor, " G"]:
        """By how much each stretch's cost is lower after a step of its own from the given camera."""
        scores, information = self.scores[:, :free], self.information[:, :free, :free]
        quadratic = (step[:, None] @ information @ step[..., None])[:, 0, 0]
        return (scores * step).sum(-1) - 0.5 * quadratic

    def _scatter(self, free: int) -> Float[Tensor, "f f"]:
        """Covariance of the whitened sum of scores about their minimum, in units of the stated variance.

        It is `variance` times the identity for independent errors.
        """
        scores, information = self.scores[:, :free], self.information[:, :free, :free]
        whole = information.sum(0)
        minimum = torch.linalg.solve(whole, scores.sum(0))
        left = scores - (information @ minimum[..., None])[..., 0]
        whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(whole), left.mT, upper=False)
        count = len(scores)
        usual = USUAL_STRETCHES * USUAL_FACTOR**2 * self.variance
        eye = torch.eye(free, dtype=scores.dtype, device=scores.device)
        return (usual * eye + count * whitened @ whitened.mT) / (USUAL_STRETCHES + count - 1)


@full_precision
def camera_evidence(
    problem: BundleProblem,
    given: CameraMeasurement,
    options: SolverOptions = GRAPH_OPTIONS,
    when: Shaped[Tensor, " K"] | None = None,
) -> CameraEvidence | None:
    """Compute the evidence of a bundle adjustment about its camera. Detached.

    `camera_evidence(problem, given).estimate().departure` is the number of standard errors by which the images
    contradict the given camera, in the directions that the stretches of the recording agree on.

    Args:
        problem: at its minimum, with the camera found there.
        given: the given camera with its error.
        options: kernel and scale of that minimum.
        when: numbers that order the frames in time; None: they are in that order.

    Returns:
        The evidence; None where the images do not determine the camera.

    Raises:
        ValueError: the directions are of another number of parameters than the camera has.
    """
    parameters = problem.camera.params.shape[-1]
    if len(given.directions) != parameters:
        raise ValueError(f"given.directions must have {parameters} rows, not {len(given.directions)}")
    is_calibration = given.focal_std <= CALIBRATED_STD
    if is_calibration:
        given = replace(given, directions=CONTRADICTED * given.directions)
    found = camera_scores(problem, given.directions, options)
    if found is None or len(problem.T_cw) < 2:
        return None
    # A point and all its observations belong to one stretch: they have a common error.
    frames, points = len(problem.T_cw), len(problem.points_w)
    frame = found.frame_index if when is None else torch.argsort(torch.argsort(when))[found.frame_index]
    seen = torch.bincount(found.point_index, minlength=points).clamp_min(1)
    middle = torch.bincount(found.point_index, frame.to(found.scores), points) / seen
    count = min(max(frames // STRETCH_FRAMES, 2), MAX_STRETCHES)
    stretch = (middle * count / frames).long().clamp_max(count - 1)[found.point_index]
    n = given.directions.shape[1]
    scores = found.scores.new_zeros(count, n).index_add(0, stretch, found.scores)
    information = found.scores.new_zeros(count, n, n).index_add(0, stretch, found.information)
    off = problem.camera.params.detach() - given.camera.params
    step = torch.linalg.pinv(given.directions) @ off
    at_given = scores + (information @ step[..., None])[..., 0]
    return CameraEvidence(given, at_given, information, float(found.variance), is_calibration)


def graph_evidence(graph: ObservationGraph, given: CameraMeasurement) -> CameraEvidence | None:
    """`camera_evidence` of the submap with most keyframes of a graph that is at its minimum."""
    frames, *_, problem = keyframe_problem(graph, graph.main_submap)
    return camera_evidence(problem, given, when=graph.timestamps[frames])


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
    shaking: ShakingTest = ShakingTest.NEVER,
) -> SensorEstimate:
    """Estimate the readout and the camera of a graph of one submap. Detached.

    Args:
        graph: with the camera and the readout in use.
        prior: what is known without it.
        options: of the adjustment of its keyframes.
        readout_frames: most frames from which the readout is estimated.
        shaking: as in `find_rolling_shutter`, by the last readout.
    """
    readout, shutter = graph.readout, None
    if prior.readout.is_sought or prior.readout.is_given:
        # Gauss-Newton steps, each with the keypoints corrected by the one before: the second changes it by a thirtieth.
        first = ShakingTest.NEVER if shaking is ShakingTest.NEVER else ShakingTest.UNLESS_READ_OUT
        for test in (first, shaking):
            shutter = find_rolling_shutter(replace(graph, readout=readout), readout_frames, test)
            # The one in use stays where none is better.
            readout = readout_by(shutter, prior.readout) or readout
            if readout is None:
                break
    is_other = readout is not graph.readout
    if readout is not None and graph.readout is not None:  # by more than its error
        is_other = abs(float(readout.seconds) - float(graph.readout.seconds)) > readout.std
    held = SensorEstimate(SensorModel(graph.camera, readout), False, is_other, 0.0, shutter)
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


def keyframe_evidence(
    graph: ObservationGraph, given: CameraMeasurement, options: SolverOptions
) -> CameraEvidence | None:
    """Adjust the submap with most keyframes of a graph with a free camera, of which `given` is the prior, and compute
    what they determine of it; None where they do not determine it."""
    graph = graph.global_shutter()
    keyframes, *_, problem = keyframe_problem(graph, graph.main_submap)
    problem = replace(problem, camera=with_radial_terms(problem.camera), camera_prior=camera_prior(given))
    found = solve_bundle(problem, free_camera=given.directions, check=False, options=options)
    at = replace(problem, T_cw=found.T_cw, points_w=found.points_w, camera=found.camera, camera_prior=None)
    return camera_evidence(at, given, options, graph.timestamps[keyframes])
