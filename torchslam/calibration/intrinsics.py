"""Estimate the intrinsics from the graph of a run, with their uncertainty.

The minimal cost of a graph over its poses and points is a function of the camera. Newton steps on it are those of a
bundle adjustment with free focal length and distortion, poses and points eliminated by the Schur complement.

The formal standard error assumes independent pixel errors. Real errors are correlated, so it is scaled by how much
parts of the trajectory disagree (the Birge ratio, 1932). Parameters that the fit holds fixed add what they would
change: a guessed principal point, and a distortion that is left out.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import (
    CX,
    CY,
    FOCAL,
    K1,
    K2,
    intrinsics_directions,
    simplify_model,
    with_radial_terms,
)
from torchslam.optim import BUNDLE_OPTIONS, BundleProblem, BundleSolution, solve_bundle
from torchslam.optim.run_graph import ObservationGraph

# A distortion coefficient must lower the cost by this ratio; a smaller gain may also come from an error of the focal
# length or the map. Tried at this value only.
MIN_COST_DECREASE = 0.02
# Prior standard deviations of what is not calibrated: the principal point from the image center, in widths, and k1
# of a lens without visible distortion. Tried at these values only.
PRINCIPAL_POINT_STD, K1_STD = 0.01, 0.05
NUM_PARTS, PART_KEYFRAMES = 4, 6
"""Parts of the trajectory, and minimum keyframes of each: fewer hardly determine a focal length. Tried only so."""
UNCHECKED_FACTOR = 2.0
"""On the formal error of a trajectory too short to be split: the least by which parts of real sequences disagree."""
BOUNDS = 0.3, 5.0
"""Of the focal length in widths: fields of view of 118 to 11 degrees. Tried at these values only."""
MAX_DETERMINED_STD = 0.1  # relative error above which a focal length counts as unknown


@dataclass(frozen=True)
class IntrinsicsEstimate:
    """The camera that minimizes the cost of a graph.

    Attributes:
        camera: With the estimated parameters.
        num_radial: Number of estimated distortion coefficients.
        focal_std: Relative standard error of the focal length, all uncertainties included.
        conditional_focal_std: The same if principal point and distortion are given exactly.
        k_std: Standard errors of the estimated distortion coefficients.
        cost: Minimal cost per observation with this camera.
        initial_cost: Minimal cost per observation with the camera of the run.
    """

    camera: Camera
    num_radial: int
    focal_std: float
    conditional_focal_std: float
    k_std: tuple[float, ...]
    cost: float
    initial_cost: float

    @property
    def is_determined(self) -> bool:
        """Whether the motion determines the focal length."""
        low, high = BOUNDS
        return (
            self.focal_std < MAX_DETERMINED_STD and low < float(self.camera.focal) / self.camera.width < high
        )


def estimate_intrinsics(
    graph: ObservationGraph, start: Camera | None = None, radial: int = 0, principal_point: bool = False
) -> IntrinsicsEstimate:
    """Fit the focal length, and up to `radial` distortion coefficients that lower the cost enough, to a run's graph.

    Args:
        graph: Of a run.
        start: Camera whose distortion is kept where none is fitted; the graph's camera if None.
        radial: Maximum number of distortion coefficients.
        principal_point: Whether the principal point of `start` is a guess, to be combined with that of the images.

    Returns:
        The estimate with its standard errors.
    """
    graph = graph.global_shutter()
    camera = with_radial_terms(graph.camera)
    base = camera if start is None else with_radial_terms(start)
    problem = problem_of(replace(graph, camera=camera))
    fits = []
    for n in range(radial + 1):
        begin = torch.cat([camera.params[: 4 + n], base.params[4 + n :]])
        fits.append(adjust_with_camera(replace(problem, camera=camera.with_params(begin)), _fitted(n)))
    costs = [float(fit.cost) for fit in fits]
    num_radial = min(range(len(fits)), key=lambda n: costs[n] * (1 + MIN_COST_DECREASE) ** n)
    best = fits[num_radial]
    count = max(1, int(best.moved_points[problem.point_index].sum()))
    at = replace(problem, T_cw=best.T_cw, points_w=best.points_w, camera=best.camera)
    inflation = _disagreement(at, _fitted(num_radial))
    if (
        int(graph.is_keyframe.sum()) < 2 * PART_KEYFRAMES
    ):  # frames between the same keyframes have correlated errors
        inflation = max(inflation, UNCHECKED_FACTOR)
    rejected_k1 = float((fits[1].camera.params - base.params)[4]) if radial and not num_radial else None
    guess = base.params[2:4] if principal_point else None
    params, stds, conditional_focal_std = _propagate_held_parameters(
        at, _fitted(num_radial), inflation, rejected_k1, guess
    )
    return IntrinsicsEstimate(
        simplify_model(best.camera.with_params(params)),
        num_radial,
        stds[0],
        conditional_focal_std,
        tuple(stds[1:]),
        costs[num_radial] / count,
        float(adjust_with_camera(problem, []).cost) / count,
    )


def _fitted(num_radial: int) -> list[int]:
    return [FOCAL, K1, K2][: 1 + num_radial]


def _propagate_held_parameters(
    at: BundleProblem,
    fitted: list[int],
    inflation: float,
    rejected_k1: float | None,
    guess: Float[Tensor, " 2"] | None,
) -> tuple[Float[Tensor, " P"], list[float], float]:
    """The parameters, their standard errors, and that of the focal length given the held parameters.

    Fitted parameters depend linearly on held ones; the principal point is the mean of its guess and its estimate,
    weighted by their information.

    at: the problem at its solution; inflation: factor on the formal errors; rejected_k1: k1 of a fit that did not
    lower the cost enough, if any; guess: prior of the principal point, None if it is given exactly
    """
    n, k, principal_point = len(fitted), int(rejected_k1 is not None), [CX, CY] if guess is not None else []
    which = fitted + [K1] * k + principal_point
    free = adjust_with_camera(at, which)
    covariance = inflation**2 * free.covariance().camera
    if not bool((covariance.diagonal() > 0).all()):
        return at.camera.params, [math.inf] * n, math.inf
    information = torch.linalg.inv(covariance)
    own = torch.linalg.inv(information[:n, :n])
    follows = -own @ information[:n, n:]
    held = torch.zeros_like(information[n:, n:])
    move = at.camera.params.new_zeros(len(which))
    if rejected_k1 is not None:
        held[0, 0] = min(K1_STD, math.hypot(rejected_k1, float(covariance[n, n].sqrt()))) ** 2
    if guess is not None:
        said = torch.linalg.inv(covariance[n + k :, n + k :])
        prior = torch.eye(2, dtype=said.dtype, device=said.device) / PRINCIPAL_POINT_STD**2
        held[k:, k:] = torch.linalg.inv(said + prior)
        found = guess + held[k:, k:] @ said @ (free.camera.params[2:4] - guess)
        move[n + k :] = (found - at.camera.params[2:4]) / at.camera.width
    move[:n] = follows @ move[n:]
    stds = (own + follows @ held @ follows.mT).diagonal().sqrt().tolist()
    return (
        at.camera.params + intrinsics_directions(at.camera, which) @ move,
        stds,
        math.sqrt(float(own[0, 0])),
    )


def _disagreement(at: BundleProblem, fitted: list[int]) -> float:
    """The disagreement of parts of the trajectory on the focal length, in formal standard errors; at least one.

    The stretches of `camera_evidence` would not do: a point belongs to one of them, so that they do not see that halves
    of a trajectory disagree which observe the same points.
    """
    keyframes = len(at.T_cw)
    count = min(NUM_PARTS, keyframes // PART_KEYFRAMES)
    if count < 2:
        return UNCHECKED_FACTOR
    ends = [keyframes * part // count for part in range(count + 1)]
    squares = []
    for start, stop in itertools.pairwise(ends):
        part = adjust_with_camera(subproblem(at, start, stop), fitted)
        variance = float(part.covariance().camera[0, 0])
        off = math.log(float(part.camera.focal) / float(at.camera.focal))
        squares.append(off**2 / variance if variance > 0 else 0.0)
    return max(1.0, math.sqrt(sum(squares) / (count - 1)))


OPTIONS = BUNDLE_OPTIONS.replace(scale=2.45, iterations=400, tolerance=1e-6, backward="detached")
"""Huber's kernel finds the way from a focal length that is far off, where all depths change with it and 200 iterations
are needed; its quadratic part ends where 95 % of Gaussian errors do. The tolerance is far below `MIN_COST_DECREASE`.
Tried at these values only."""
MIN_FRAMES = 24  # frames of the problem, if available


def problem_of(graph: ObservationGraph) -> BundleProblem:
    """The bundle adjustment of the frames of `frames_of` and the points that they observe."""
    frames = frames_of(graph)
    slots = torch.full_like(graph.submap, -1)
    slots[frames] = torch.arange(len(frames), device=slots.device)
    rows = (slots[graph.frame_index] >= 0).nonzero().squeeze(-1)
    points, point_index = torch.unique(graph.point_index[rows], return_inverse=True)
    return BundleProblem(
        graph.T_cw[frames],
        graph.points_w[points],
        slots[graph.frame_index[rows]],
        point_index,
        graph.pixels[rows],
        graph.camera,
        graph.weights[rows],
    )


def subproblem(problem: BundleProblem, start: int, stop: int) -> BundleProblem:
    """The frames from `start` to before `stop` and the points that they observe."""
    rows = ((problem.frame_index >= start) & (problem.frame_index < stop)).nonzero().squeeze(-1)
    points, point_index = torch.unique(problem.point_index[rows], return_inverse=True)
    assert problem.weights is not None
    return replace(
        problem,
        T_cw=problem.T_cw[start:stop],
        points_w=problem.points_w[points],
        frame_index=problem.frame_index[rows] - start,
        point_index=point_index,
        pixels=problem.pixels[rows],
        weights=problem.weights[rows],
    )


def frames_of(graph: ObservationGraph) -> Int[Tensor, " K"]:
    """The keyframes of the graph's largest submap, by time, with other frames if they are few."""
    submap = torch.bincount(graph.submap).argmax()
    frames = (graph.submap == submap).nonzero().squeeze(-1)
    frames = frames[torch.argsort(graph.timestamps[frames], stable=True)]
    keyframes = graph.is_keyframe[frames].nonzero().squeeze(-1)
    missing = MIN_FRAMES - len(keyframes)
    if missing > 0:
        others = (~graph.is_keyframe[frames]).nonzero().squeeze(-1)
        every = max(1, -(-len(others) // missing))
        keyframes = torch.cat([keyframes, others[every // 2 :: every]]).sort().values
    return frames[keyframes]


def adjust_with_camera(problem: BundleProblem, which: list[int]) -> BundleSolution:
    """Minimize the robust cost over poses, points and the selected parameters of the camera."""
    directions = intrinsics_directions(problem.camera, which)
    return solve_bundle(problem, free_camera=directions, options=OPTIONS)
