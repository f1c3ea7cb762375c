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
from torch import Tensor

from torchslam.geometry import Camera
from torchslam.optim import BundleProblem, BundleSolution, bundle_adjust
from torchslam.optim.run_graph import ObservationGraph

# A bend of the lens is believed where it lowers the cost by this share; a smaller one trades places with the focal
# length and what else is wrong with a map.
MIN_COST_DECREASE = 0.02
# Relative standard errors of what is not calibrated: centres of sensors lie this far, in widths, off their axes; k1 of
# a lens that shows no bend.
PRINCIPAL_POINT_STD, K1_STD = 0.01, 0.05
NUM_PARTS, PART_KEYFRAMES = 4, 6  # of the way, and at least so many keyframes in each
UNCHECKED_FACTOR = 2.0  # how much too small a formal error is where the way is too short to be parted
BOUNDS = 0.3, 5.0  # of the focal length in widths
MAX_DETERMINED_STD = 0.1  # relative error from which on a focal length counts as unknown


@dataclass(frozen=True)
class Refinement:
    """The camera under which a graph costs least.

    num_radial:  how many coefficients of the distortion were fitted beside the focal length
    std:         relative standard error of the focal length, with all that is not certain
    given_rest:  the same if principal point and distortion are as they are said to be
    k_std:       standard errors of the coefficients that were fitted
    cost, cost_before: the least ones per observation, with this camera and with the one of the run
    """

    camera: Camera
    num_radial: int
    std: float
    given_rest: float
    k_std: tuple[float, ...]
    cost: float
    cost_before: float

    @property
    def is_determined(self) -> bool:
        """Whether the motion says what the focal length is."""
        low, high = BOUNDS
        return self.std < MAX_DETERMINED_STD and low < float(self.camera.focal) / self.camera.width < high


def estimate_intrinsics(
    graph: ObservationGraph, start: Camera | None = None, radial: int = 0, principal_point: bool = False
) -> Refinement:
    """Fit focal length and, where the residuals ask for them, up to `radial` coefficients to a run's graph.

    start:  whose distortion is kept where none is fitted, the graph's camera if None
    centre: its principal point is a guess, too: the images move it as far as they are surer than the guess
    """
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
    doubt = _disagreement(at, _fitted(num_radial))
    if int(graph.is_keyframe.sum()) < 2 * PART_KEYFRAMES:  # frames between the same keyframes err together
        doubt = max(doubt, UNCHECKED_FACTOR)
    bend = float((fits[1].camera.params - base.params)[4]) if radial and not num_radial else None
    guess = base.params[2:4] if principal_point else None
    params, stds, given_rest = _propagate_held_parameters(at, _fitted(num_radial), doubt, bend, guess)
    return Refinement(
        simplify_model(best.camera.with_params(params)),
        num_radial,
        stds[0],
        given_rest,
        tuple(stds[1:]),
        costs[num_radial] / count,
        float(adjust_with_camera(problem, []).cost) / count,
    )


def _fitted(num_radial: int) -> list[int]:
    return [FOCAL, K1, K2][: 1 + num_radial]


def _propagate_held_parameters(
    at: BundleProblem, fitted: list[int], doubt: float, bend: float | None, guess: Tensor | None
) -> tuple[Tensor, list[float], float]:
    """The parameters (K,) once the centre has moved, their errors, and that of the focal length given the rest.

    What was fitted follows what was held in proportion; the centre is the mean of the guess and of what the images say
    of it, weighted by how sure they are.

    at:    the problem at its solution; doubt: factor on the formal errors
    bend:  k1 by a fit that was not believed, where there was one
    guess: (2,) the principal point before the images were asked; None where it is given
    """
    n, k, principal_point = len(fitted), int(bend is not None), [CX, CY] if guess is not None else []
    which = fitted + [K1] * k + principal_point
    free = adjust_with_camera(at, which)
    covariance = doubt**2 * free.covariance().camera
    if not bool((covariance.diagonal() > 0).all()):
        return at.camera.params, [math.inf] * n, math.inf
    information = torch.linalg.inv(covariance)
    own = torch.linalg.inv(information[:n, :n])
    follows = -own @ information[:n, n:]
    held = torch.zeros_like(information[n:, n:])
    move = at.camera.params.new_zeros(len(which))
    if bend is not None:
        held[0, 0] = min(K1_STD, math.hypot(bend, float(covariance[n, n].sqrt()))) ** 2
    if guess is not None:
        said = torch.linalg.inv(covariance[n + k :, n + k :])
        prior = torch.eye(2, dtype=said.dtype, device=said.device) / PRINCIPAL_POINT_STD**2
        held[k:, k:] = torch.linalg.inv(said + prior)
        found = guess + held[k:, k:] @ said @ (free.camera.params[2:4] - guess)
        move[n + k :] = (found - at.camera.params[2:4]) / at.camera.width
    move[:n] = follows @ move[n:]
    stds = (own + follows @ held @ follows.mT).diagonal().sqrt().tolist()
    return at.camera.params + directions(at.camera, which) @ move, stds, math.sqrt(float(own[0, 0]))


def _disagreement(at: BundleProblem, fitted: list[int]) -> float:
    """By how much parts of the way disagree on the focal length, in units of their formal errors; one at least."""
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


KERNEL_SCALE = 2.45  # as in `solve`: ends the quadratic part at 95 % of a Gaussian
TOLERANCE = 1e-6
ITERATIONS = 400  # where all depths have to move with a focal length that is far off, 200 are needed
MIN_FRAMES = 24  # frames that a camera is refined on, if there are
# What is looked at of a camera, in this order: the logarithm of the focal length, k1, k2, and the principal point.
FOCAL, K1, K2, CX, CY = range(5)


def problem_of(graph: ObservationGraph) -> BundleProblem:
    """The frames of `frames_of` and the points that they see."""
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
    """The frames from `start` to before `stop` and the points that they see."""
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


def frames_of(graph: ObservationGraph) -> Tensor:
    """(n,) the keyframes of the graph's largest world, by time; where they are few, frames in between with them."""
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


def directions(camera: Camera, which: list[int]) -> Tensor:
    """(K, n) how the camera's parameters change with the log of the focal length, k1, k2, and the centre in widths."""
    columns = camera.params.new_zeros(len(camera.params), 5)
    columns[:2, FOCAL] = camera.params[:2]
    columns[[2, 3], [CX, CY]] = float(camera.width)
    if camera.model != "pinhole":
        columns[[4, 5], [K1, K2]] = 1.0
    return columns[:, which]


def adjust_with_camera(
    problem: BundleProblem, which: list[int], iterations: int = ITERATIONS
) -> BundleSolution:
    """The least robust cost over poses, points and those parameters of the camera."""
    return bundle_adjust(
        problem,
        "huber",
        KERNEL_SCALE,
        directions(problem.camera, which),
        "detached",
        iterations,
        TOLERANCE,
    )


def with_radial_terms(camera: Camera) -> Camera:
    """The same camera in a model that can bend the image."""
    if camera.model != "pinhole":
        return camera
    return Camera("radial_tangential", torch.cat([camera.params, camera.params.new_zeros(5)]), camera.size)


def simplify_model(camera: Camera) -> Camera:
    """The same camera, as a pinhole where it does not bend the image."""
    if camera.model != "radial_tangential" or bool(camera.params[4:].any()):
        return camera
    return Camera("pinhole", camera.params[:4], camera.size)
