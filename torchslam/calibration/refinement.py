"""The camera that the graph of a run asks for, and how much of that may be believed.

The least cost of a graph, over its poses and points, is a function of the camera; Newton steps on it are those of the
bundle adjustment in which focal length and distortion move, too, poses and points eliminated by the Schur complement.

The formal standard error counts every pixel as an error of its own. Real ones err together, so it is scaled by how much
parts of the way disagree (the ratio of Birge, 1932), and what the fit holds fixed adds what it would change: the
principal point, and a bend of the lens that is left out.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.calibration.keyframes import (
    CX,
    CY,
    FOCAL,
    K1,
    K2,
    adjust,
    part_of,
    problem_of,
    simplest,
    with_radial_terms,
)
from torchslam.geometry import Camera
from torchslam.solvers import BundleProblem
from torchslam.solvers.graph import ObservationGraph

# A bend of the lens is believed where it lowers the cost by this share; a smaller one trades places with the focal
# length and what else is wrong with a map.
WORTH = 0.02
# Relative standard errors of what is not calibrated: centres of sensors lie this far, in widths, off their axes; k1 of
# a lens that shows no bend.
CENTRE_STD, K1_STD = 0.01, 0.05
PARTS, PART_KEYFRAMES = 4, 6  # of the way, and at least so many keyframes in each
UNCHECKED = 2.0  # how much too small a formal error is where the way is too short to be parted
BOUNDS = 0.3, 5.0  # of the focal length in widths
UNDETERMINED = 0.1  # relative error from which on a focal length counts as unknown


@dataclass(frozen=True)
class Refinement:
    """The camera under which a graph costs least.

    num_radial:  how many coefficients of the distortion were fitted beside the focal length
    std:         relative standard error of the focal length, with all that is not certain
    given_rest:  the same if principal point and distortion are as they are said to be
    k_std:       standard errors of the coefficients that were fitted
    cost, cost_before: per observation, with this camera and with the one of the run
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
        return self.std < UNDETERMINED and low < float(self.camera.focal) / self.camera.width < high


def refine(graph: ObservationGraph, straight: Camera | None = None, radial: int = 0) -> Refinement:
    """Fit focal length and, where the residuals ask for them, up to `radial` coefficients to a run's graph.

    straight: whose distortion is kept where none is fitted; that of the graph's camera if None
    """
    camera = with_radial_terms(graph.camera)
    base = camera if straight is None else with_radial_terms(straight)
    problem = problem_of(replace(graph, camera=camera))
    fits = []
    for n in range(radial + 1):
        begin = torch.cat([camera.params[: 4 + n], base.params[4 + n :]])
        fits.append(adjust(replace(problem, camera=camera.with_params(begin)), _fitted(n)))
    costs = [float(fit.cost) for fit in fits]
    num_radial = min(range(len(fits)), key=lambda n: costs[n] * (1 + WORTH) ** n)
    best = fits[num_radial]
    count = max(1, int(best.moved_points[problem.point_index].sum()))
    at = replace(problem, T_cw=best.T_cw, points_w=best.points_w, camera=best.camera)
    doubt = _disagreement(at, _fitted(num_radial))
    held = {} if radial == 0 else {CX: CENTRE_STD, CY: CENTRE_STD}
    bend = float((fits[1].camera.params - base.params)[4]) if radial and not num_radial else None
    covariance, std = _errors(at, _fitted(num_radial), doubt, held, bend)
    return Refinement(
        simplest(best.camera),
        num_radial,
        std,
        doubt * math.sqrt(float(covariance[0, 0])),
        tuple((doubt * covariance.diagonal()[1:].sqrt()).tolist()),
        costs[num_radial] / count,
        float(fits[-1].convergence.initial_cost) / count,
    )


def _fitted(num_radial: int) -> list[int]:
    return [FOCAL, K1, K2][: 1 + num_radial]


def _errors(
    at: BundleProblem,
    fitted: list[int],
    doubt: float,
    held: dict[int, float],
    bend: float | None,
) -> tuple[Tensor, float]:
    """Formal covariance (n, n) of what was fitted, and the relative error of the focal length with what was not.

    at:    the problem at its solution
    doubt: factor on the formal errors; held: standard errors of parameters that were held fixed
    bend:  k1 by a fit that was not believed, where there was one
    """
    others = [K1] * (bend is not None) + list(held)
    covariance = adjust(at, fitted + others, iterations=0).covariance().camera
    n = len(fitted)
    if not bool((covariance.diagonal() > 0).all()):
        return torch.full_like(covariance[:n, :n], math.inf), math.inf
    information = torch.linalg.inv(covariance)
    given_rest = torch.linalg.inv(information[:n, :n])
    follows = (given_rest @ information[:n, n:])[0]  # how the focal length follows what is held
    stds = [held.get(which, 0.0) for which in others]
    if bend is not None:
        stds[0] = min(K1_STD, math.hypot(bend, doubt * math.sqrt(float(covariance[n, n]))))
    variance = doubt**2 * given_rest[0, 0] + (follows * follows.new_tensor(stds)).square().sum()
    return given_rest, math.sqrt(float(variance))


def _disagreement(at: BundleProblem, fitted: list[int]) -> float:
    """By how much parts of the way disagree on the focal length, in units of their formal errors; one at least."""
    keyframes = len(at.T_cw)
    count = min(PARTS, keyframes // PART_KEYFRAMES)
    if count < 2:
        return UNCHECKED
    ends = [keyframes * part // count for part in range(count + 1)]
    squares = []
    for start, stop in itertools.pairwise(ends):
        part = adjust(part_of(at, start, stop), fitted)
        variance = float(part.covariance().camera[0, 0])
        off = math.log(float(part.camera.focal) / float(at.camera.focal))
        squares.append(off**2 / variance if variance > 0 else 0.0)
    return max(1.0, math.sqrt(sum(squares) / (count - 1)))
