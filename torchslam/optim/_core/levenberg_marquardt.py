"""Levenberg-Marquardt for many independent least-squares problems at once, and the options of all solvers.

The loop knows nothing of poses or points: a `LeastSquares` problem evaluates a local quadratic model, proposes a damped
step, and chooses per element between the old model and the new one. Every element has its own damping, accepts or
rejects its own steps and stops on its own, so a batch gives what the elements alone would give. Under autograd the loop
can be differentiated through ("unroll"). Sources: Levenberg, 1944; Marquardt, 1963; Madsen, Nielsen and Tingleff,
"Methods for non-linear least squares problems", 2004.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Protocol, Self, TypeVar, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils._pytree import tree_map

from torchslam.errors import ConvergenceError, ConvergenceWarning
from torchslam.geometry.robust import TAIL_SCALE, Kernel
from torchslam.optim._core.implicit import Backward
from torchslam.utils.by_value import ByValue
from torchslam.utils.torch_internals import in_transform

INITIAL_DAMPING = 1e-4
"""Relative to the diagonal of the Hessian: nearly a step of Gauss and Newton at first. Tried at this value only."""
DAMPING_DOWN, DAMPING_UP = 0.1, 10.0
"""Factors on the damping after a step that lowers the cost as predicted, and after another one (Marquardt, 1963)."""
TRUSTED = 0.25
"""Least share of the predicted reduction that a step must bring so that the damping falls, as of trust regions (Nocedal
and Wright, "Numerical optimization", section 4.1): a few far points may promise reductions that never come, step after
step. On redkitchen, mapped as a whole, two rounds of adjustment take 17 and 13 steps in place of 33 and 56 without it;
with .01 they take 17 and 34."""
_DAMPING_RANGE = (1e-10, 1e8)
"""Below, a step is that of Gauss and Newton; above, it is too short to matter, and the element gives up."""
CURVATURE_BELOW = 1e-2
"""Predicted relative reduction of the cost below which the kernel's curvature is used."""

Progress = Callable[[int, int], None]
"""Called before each iteration with its number, from 0, and the maximum number of iterations."""


class Model(Protocol):
    """A local quadratic model of a cost; `cost` is (B,)."""

    @property
    def cost(self) -> Float[Tensor, " B"]: ...


M = TypeVar("M", bound=Model)
X = TypeVar("X")


class LeastSquares(Protocol[X, M]):
    """A problem with estimates X and local models M."""

    @property
    def solvable(self) -> Bool[Tensor, " B"]:
        """Which elements to minimize; the others stay at their start."""
        ...

    def evaluate(self, estimate: X, use_curvature: Bool[Tensor, " B"]) -> M:
        """The cost and its quadratic model at an estimate, with the kernel's curvature where it is used."""
        ...

    def step(self, model: M, damping: Float[Tensor, " B"]) -> tuple[X, Float[Tensor, " B"]]:
        """The estimate that minimizes the damped model, and the decrease of the cost that the model predicts; infinite
        where there is no solution. The damping is relative to the diagonal of the Hessian."""
        ...

    def select(self, accept: Bool[Tensor, " B"], new: M, old: M) -> M:
        """Per element, `new` where `accept` and `old` elsewhere: `select_models`."""
        ...


class Divisible(Protocol):
    """A problem whose models are named tuples of batched tensors: elements that have converged leave the batch."""

    def part(self, rows: Int[Tensor, " R"]) -> Self:
        """The problems of some elements."""
        ...


class Rounded(Protocol):
    """A problem with known rounding errors: a cost below them cannot be reduced."""

    def rounding(self) -> Float[Tensor, " B"]:
        """The cost of exact data, from rounding alone."""
        ...


class Drifting(Protocol):
    """A problem that may have no minimum because its unknowns drift to a limit where it is degenerate."""

    def drifts(self, old: Any, new: Any, relative_reduction: Float[Tensor, " B"]) -> Bool[Tensor, " B"]:
        """Which elements to give up, called once for each step that was accepted."""
        ...


class Concluding(Protocol):
    """A problem whose last step is taken without an evaluation, which is a fifth of a short search."""

    concludes: bool

    def concluded(self, model: Any, estimate: Any) -> Any:
        """The model at an estimate that is so close that its derivatives are the same."""
        ...


class SolverReason(Enum):
    """How a search ended."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "not converged: allow more iterations"
    GAVE_UP = "not converged: no shorter step lowers the cost"
    UNDETERMINED = (
        "not determined: too few observations, a degenerate configuration, a start that is not finite, or factors "
        "that shrink the map without limit"
    )

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Convergence:
    """Convergence of a minimization, per element.

    Attributes:
        iterations: steps tried.
        converged: the predicted reduction of the last step was below the tolerance.
        initial_cost: half the sum of robustified squared residuals at the start.
        cost: the same at the end.
        limit: of the iterations.
    """

    iterations: Int[Tensor, " B"]
    converged: Bool[Tensor, " B"]
    initial_cost: Float[Tensor, " B"]
    cost: Float[Tensor, " B"]
    limit: int = field(kw_only=True)

    def reasons(self, success: Bool[Tensor, "*batch"]) -> list[SolverReason]:
        """How the search ended for each element of a solution, given which of them are determined."""
        shape = success.flatten().shape
        rows = (x.expand(shape).tolist() for x in (success.flatten(), self.converged, self.iterations))

        def reason(determined: bool, converged: bool, steps: int) -> SolverReason:
            if not determined:
                return SolverReason.UNDETERMINED
            if converged:
                return SolverReason.CONVERGED
            return SolverReason.GAVE_UP if steps < self.limit else SolverReason.ITERATION_LIMIT

        return [reason(*row) for row in zip(*rows, strict=True)]

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """All but the limit."""
        return self.iterations, self.converged, self.initial_cost, self.cost

    def of(self, row: int) -> Convergence:
        """Of one element."""
        return Convergence(*(tensor[row : row + 1] for tensor in self.tensors), limit=self.limit)


class Outcome:
    """How the search for a solution ended. It can be pickled, without gradients."""

    success: Bool[Tensor, "*batch"]
    convergence: Convergence

    def __getstate__(self) -> dict[str, Any]:
        return {name: tree_map(_detached, value) for name, value in vars(self).items()}

    @property
    def converged(self) -> Bool[Tensor, "*batch"]:
        """The search ended at a minimum. Elsewhere the gradient may be wrong by any factor, `success` or not."""
        return self.convergence.converged.view_as(self.success)

    @property
    def reasons(self) -> list[SolverReason]:
        """How the search ended, for each element."""
        return self.convergence.reasons(self.success)


_quiet = ContextVar("_quiet", default=False)
"""Whether a solver is part of another one, which warns for both."""


@contextmanager
def part_of_a_solver() -> Iterator[None]:
    """Solvers inside do not warn of gradients of their own."""
    token = _quiet.set(True)
    try:
        yield
    finally:
        _quiet.reset(token)


def warned(tensor: Tensor, success: Tensor, convergence: Convergence, what: str) -> Tensor:
    """A solution (..., n, m), whose first dimension is that of the elements, that warns once when a gradient passes an
    element that is not at a minimum. Under `torch.func` it does not."""
    if _quiet.get() or in_transform() or not tensor.requires_grad:
        return tensor
    unfinished = success.flatten() & ~convergence.converged.expand(success.numel())
    if not bool(unfinished.any()):
        return tensor
    tensor = tensor.view_as(tensor)
    has_warned: list[bool] = []

    def warn(gradient: Tensor | None) -> None:
        if gradient is None or has_warned:
            return
        rows = unfinished & (gradient != 0).reshape(len(unfinished), -1).any(-1)
        if not bool(rows.any()):
            return
        has_warned.append(True)
        reasons = Counter(
            str(reason)
            for reason, row in zip(convergence.reasons(success), rows.tolist(), strict=True)
            if row
        )
        warnings.warn(
            f"gradient of {int(rows.sum())} of {len(rows)} {what} that are not at a minimum, which may be wrong by any "
            f"factor ({'; '.join(f'{count} {reason}' for reason, count in reasons.items())})",
            ConvergenceWarning,
            stacklevel=2,
        )

    tensor.register_hook(warn)
    return tensor


def _detached(value: Any) -> Any:
    return value.detach() if isinstance(value, Tensor) else value


def check_minimum(success: Bool[Tensor, "*batch"], converged: Bool[Tensor, "*batch"], what: str) -> None:
    """Raise ConvergenceError with the rows of the elements, which are named by `what`, that are not at a minimum."""
    undetermined = (~success).flatten().nonzero().flatten().tolist()
    unfinished = (success & ~converged).flatten().nonzero().flatten().tolist()
    kinds = (undetermined, "not determined"), (unfinished, "not converged: allow more iterations")
    parts = [
        f"{len(rows)} {problem} ({', '.join(map(str, rows[:10]))}{', ...' if len(rows) > 10 else ''})"
        for rows, problem in kinds
        if rows
    ]
    if parts:
        raise ConvergenceError(f"of {success.numel()} {what}: {'; '.join(parts)}")


Tree = TypeVar("Tree")
"""Nested named tuples of batched tensors."""


def index_tree(tree: Tree, rows: Int[Tensor, " R"]) -> Tree:
    """Select elements of a batch by their rows (b,)."""
    return tree_map(lambda tensor: tensor.index_select(0, rows), tree)


def where_tree(first: Bool[Tensor, " B"], one: Tree, other: Tree) -> Tree:
    """Select per element: `one` where `first` (B,) is true, `other` elsewhere."""
    return tree_map(lambda a, b: torch.where(first.view(-1, *(1,) * (a.ndim - 1)), a, b), one, other)


def select_models(accept: Bool[Tensor, " B"], new: Tree, old: Tree) -> Tree:
    """Per element, `new` where `accept` and `old` elsewhere; a model that is no tree has one element."""
    if bool(accept.all()):
        return new
    return where_tree(accept, new, old) if bool(accept.any()) else old


def minimize_batch(
    problem: LeastSquares[X, M],
    start: X,
    iterations: int,
    tolerance: float,
    progress: Progress | None = None,
) -> tuple[M, Convergence]:
    """Minimize from `start`; returns the model at the last accepted estimate.

    An element has converged when the predicted reduction of its cost is below `tolerance` times the cost, or when its
    residuals have vanished; it stays unchanged from then on. So does one for which the shortest step is too long, which
    has not converged. An exception of `progress` ends the minimization.
    """
    active = problem.solvable
    model = problem.evaluate(start, torch.zeros_like(active))
    initial_cost = model.cost.detach().clone()  # results share no memory
    # Close to the optimum a step lowers the gradient long after the cost changes by rounding only.
    rounding = torch.finfo(initial_cost.dtype).eps
    slack = 1 + 100 * rounding
    vanished = rounding**1.5 * initial_cost
    if hasattr(problem, "rounding"):  # as `Rounded`; to ask for a protocol takes .1 ms
        vanished = torch.maximum(vanished, problem.rounding())
    damping = torch.full_like(initial_cost, INITIAL_DAMPING)
    steps, given_up = torch.zeros_like(active, dtype=torch.int64), torch.zeros_like(active)
    rows, finished = torch.arange(len(active), device=active.device), []
    drifting, divisible, concludes = (
        hasattr(problem, "drifts"),
        hasattr(problem, "part"),
        getattr(problem, "concludes", False),
    )
    for iteration in range(iterations):
        if progress is not None:
            progress(iteration, iterations)
        estimate, predicted_reduction = problem.step(model, damping)
        relative_reduction = predicted_reduction.detach() / model.cost.detach()
        if concludes and (~active | (relative_reduction <= tolerance)).all():
            moved = problem.concluded(model, estimate)  # type: ignore[attr-defined]
            model = problem.select(active, moved, model)
            steps, active = steps.index_add(0, rows, active.long()), torch.zeros_like(active)
            break
        trial = problem.evaluate(estimate, relative_reduction < CURVATURE_BELOW)
        accept = active & (relative_reduction < torch.inf) & (trial.cost <= slack * model.cost)
        steps = steps.index_add(0, rows, active.long())
        active = active & (relative_reduction > tolerance) & (model.cost.detach() > vanished)
        drifts = torch.zeros_like(active)
        if drifting and bool(accept.all()):
            drifts = active & problem.drifts(model, trial, relative_reduction)  # type: ignore[attr-defined]
        reduction = model.cost.detach() - trial.cost.detach()
        trusted = accept & (reduction > TRUSTED * predicted_reduction.detach())
        model = problem.select(accept, trial, model)
        stuck = active & ~accept & (damping >= _DAMPING_RANGE[1])  # no shorter step is to be had
        stuck = stuck | drifts
        given_up = given_up.index_copy(0, rows, stuck)
        active = active & ~stuck
        damping = torch.where(trusted, damping * DAMPING_DOWN, damping * DAMPING_UP).clamp(*_DAMPING_RANGE)
        if not active.any():
            break
        if divisible and not active.all():
            done, stay = (~active).nonzero().squeeze(-1), active.nonzero().squeeze(-1)
            finished.append((rows[done], index_tree(model, done)))
            problem, model = problem.part(stay), index_tree(model, stay)  # type: ignore[attr-defined]
            rows, active, damping, vanished = index_tree((rows, active, damping, vanished), stay)
    converged = torch.ones_like(steps, dtype=torch.bool).index_copy(0, rows, ~active) & ~given_up
    if finished:
        where, models = zip(*finished, (rows, model), strict=True)
        order = torch.argsort(torch.cat(where))
        model = tree_map(lambda *parts: torch.cat(parts).index_select(0, order), *models)
    return model, Convergence(steps, converged, initial_cost, model.cost.detach(), limit=iterations)


@dataclass(frozen=True, eq=False)
class SolverOptions(ByValue):
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
    iterations: int = 200  # a Huber kernel with a fifth of outliers needs up to 50
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
