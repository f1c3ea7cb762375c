"""How a solver minimizes: one set of options for all of them, and the defaults of each with their reasons."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Self, get_args

from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.robust import TAIL_SCALE, Kernel
from torchslam.optim._core.implicit import Backward

MAX_ITERATIONS = 200
"""With a fifth of outliers a Huber kernel needs up to 50, and short of the minimum the gradient is another one."""


@dataclass(frozen=True)
class SolverOptions:
    """How a solver minimizes.

    Each solver has a constant with its defaults: `solve_pose(..., options=POSE_OPTIONS.replace(strict=True))`.

    Attributes:
        kernel: robust kernel.
        scale: of the kernel, in units of the whitened residual: a number, a scalar tensor, or (B,) of a batch.
        iterations: maximum number of steps.
        tolerance: stop where the predicted reduction of the cost is below this share of it.
        backward: how gradients reach the inputs.
        strict: raise ConvergenceError for any element that is not at a minimum: `success` or `converged` is False.

    Raises:
        ValueError: A name is unknown, or a number is below zero.
    """

    kernel: Kernel
    scale: Float[Tensor, "*#scale"] | float
    iterations: int = MAX_ITERATIONS
    tolerance: float = 1e-8
    backward: Backward = "implicit"
    strict: bool = False

    def __post_init__(self) -> None:
        if self.kernel not in get_args(Kernel):
            raise ValueError(f"unknown kernel {self.kernel!r}; known are {', '.join(get_args(Kernel))}")
        if not self.iterations >= 0:
            raise ValueError(f"iterations must not be below zero, got {self.iterations}")
        if not self.tolerance >= 0:
            raise ValueError(f"tolerance must not be below zero, got {self.tolerance}")
        if self.backward not in get_args(Backward):
            known = ", ".join(get_args(Backward))
            raise ValueError(f"unknown backward mode {self.backward!r}; known are {known}")

    def replace(self, **changes: Any) -> Self:
        """The same options with some changed."""
        return replace(self, **changes)


LEAST_SQUARES_OPTIONS = SolverOptions("none", 1.0, tolerance=1e-10)
"""Plain least squares, as nothing is known of the residual; the tolerance as for poses, since problems are as small."""

POSE_OPTIONS = SolverOptions("cauchy", 1.0, tolerance=1e-10)
"""Matches to known points are the least certain ones: Cauchy's kernel gives up on wrong ones, as Huber's does not.

The scale is one standard deviation. Steps of six unknowns cost little, and gradients are then right to about 1e-4."""

BUNDLE_OPTIONS = SolverOptions("huber", 1.0)
"""Huber's kernel is convex in the residual: frames and points far from the minimum find the way. The scale is one
standard deviation."""

POSE_GRAPH_OPTIONS = SolverOptions("huber", 3.75)
"""95 % of the norms of seven standard normal numbers lie below the scale: edges are averages and mostly right."""

ROTATION_OPTIONS = SolverOptions("geman_mcclure", 2.8)
"""Relative rotations are right or wrong by any angle, which a kernel without a limit would average. 95 % of the norms
of three standard normal numbers lie below the scale."""

UNWEIGHTED_ROTATION_OPTIONS = ROTATION_OPTIONS.replace(scale=math.radians(5.0))
"""Without weights the scale is in radians, as COLMAP's: relative rotations of two views are right to a degree or two,
or wrong."""

GRAPH_OPTIONS = SolverOptions("cauchy", TAIL_SCALE, tolerance=1e-10)
"""A run has rejected wrong matches before, but errors of right ones have heavy tails. The weights of its graph are by
the noise that the run found, which mostly is a half to a fifth of a pixel of the level."""
