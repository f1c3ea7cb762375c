"""Robust least squares of any residual, batched, with the gradients of its minimum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.func import grad, jvp

from torchslam.geometry.precision import check_dtypes, full_precision
from torchslam.geometry.robust import Kernel, kernel_scale, robustify
from torchslam.optim._core import tangent
from torchslam.optim._core.implicit import Minimization, Ndims, Tensors, find_minimum, tensors_closed_over
from torchslam.optim._core.levenberg_marquardt import (
    LEAST_SQUARES_OPTIONS,
    Convergence,
    Outcome,
    SolverOptions,
    check_minimum,
    index_tree,
    minimize_batch,
    select_models,
    warned,
    where_tree,
)
from torchslam.optim._core.linear import DefiniteFactor, diagonal_floor, factorize
from torchslam.optim._core.residuals import Linearization, flat_along

Manifold = Literal["euclidean", "se3", "sim3"]
"""What an unknown moves on.

"euclidean": any tensor (B, ...), as a vector
"se3":       rigid transforms (B, ..., 4, 4), by left perturbations (translation, rotation)
"sim3":      similarities (B, ..., 4, 4), by left perturbations (translation, rotation, log scale)
"""


_Move = Callable[[Tensor, Tensor], Tensor]
_MATRICES: dict[str, tuple[int, _Move, _Move]] = {
    "se3": (6, tangent.retract, tangent.pull_back),
    "sim3": (7, tangent.retract_sim3, tangent.pull_back_sim3),
}
"""The manifolds of matrices (..., 4, 4) by name: the dimension of steps, their retraction and the pull-back to them."""


@dataclass(frozen=True)
class Product:
    """The manifold of several unknowns, each of a shape without the batch; steps are (B, n), one after the other."""

    manifolds: tuple[Manifold, ...]
    shapes: tuple[tuple[int, ...], ...]

    @staticmethod
    def of(manifolds: Sequence[Manifold], unknowns: Sequence[Tensor]) -> Product:
        """Raises ValueError for names and shapes that do not fit."""
        if len(manifolds) != len(unknowns):
            raise ValueError(f"there are {len(unknowns)} unknowns, but {len(manifolds)} manifolds")
        for name, unknown in zip(manifolds, unknowns, strict=True):
            if name not in get_args(Manifold):
                raise ValueError(f"unknown manifold {name!r}; known are {', '.join(get_args(Manifold))}")
            if name in _MATRICES and (unknown.ndim < 3 or unknown.shape[-2:] != (4, 4)):
                raise ValueError(f"an unknown on {name} must be (B, ..., 4, 4), not {tuple(unknown.shape)}")
        return Product(tuple(manifolds), tuple(tuple(unknown.shape[1:]) for unknown in unknowns))

    @property
    def step_shapes(self) -> list[tuple[int, ...]]:
        """Of a step of each unknown, without the batch."""
        return [
            (*shape[:-2], _MATRICES[name][0]) if name in _MATRICES else shape
            for name, shape in zip(self.manifolds, self.shapes, strict=True)
        ]

    def sanitized(self, unknowns: Tensors) -> tuple[Tensors, Tensor]:
        """The unknowns, zero or the identity in elements that are not finite, and which are, (B,)."""
        finite = torch.stack([torch.isfinite(x).flatten(1).all(-1) for x in unknowns]).all(0)
        eye = torch.eye(4, dtype=unknowns[0].dtype, device=unknowns[0].device)
        return tuple(
            torch.where(finite.view(-1, *(1,) * (x.ndim - 1)), x, eye if name in _MATRICES else 0.0)
            for name, x in zip(self.manifolds, unknowns, strict=True)
        ), finite

    def no_step(self, unknowns: Tensors) -> Tensor:
        """(B, n) zeros."""
        return unknowns[0].new_zeros(len(unknowns[0]), sum(prod(shape) for shape in self.step_shapes))

    def retract(self, unknowns: Tensors, step: Tensor) -> Tensors:
        """The unknowns moved along a step (B, n)."""
        return tuple(
            _MATRICES[name][1](x, part) if name in _MATRICES else x + part
            for name, x, part in zip(self.manifolds, unknowns, self._parts(step), strict=True)
        )

    def push(self, unknowns: Tensors, step: Tensor) -> Tensors:
        """The change of the unknowns, to first order, along a step (B, n)."""
        return tuple(
            tangent.push(x, part) if name in _MATRICES else part
            for name, x, part in zip(self.manifolds, unknowns, self._parts(step), strict=True)
        )

    def pull_back(self, unknowns: Tensors, gradient: Tensors) -> Tensor:
        """The gradient (B, n) in the step of a loss with this gradient in the unknowns."""
        parts = (
            _MATRICES[name][2](x, part) if name in _MATRICES else part
            for name, x, part in zip(self.manifolds, unknowns, gradient, strict=True)
        )
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    def _parts(self, step: Tensor) -> list[Tensor]:
        shapes = self.step_shapes
        parts = step.split([prod(shape) for shape in shapes], dim=-1)
        return [part.reshape(len(step), *shape) for part, shape in zip(parts, shapes, strict=True)]


Residual = Callable[..., Tensor]
"""residual(*unknowns, *inputs) -> (B, N) or (B, N, D), each element from its own rows alone."""


@dataclass(frozen=True)
class LeastSquaresSolution(Outcome):
    """The minima of a batch.

    Attributes:
        unknowns: the estimates, in the order and shapes of the start.
        cost: half the sum of robustified squared whitened residuals, detached.
        success: the start and its residuals are finite, and all unknowns are determined. If False, the
            estimate is the best one found, but it has no gradient.
        convergence: iterations and convergence per element.
    """

    unknowns: Tensors
    cost: Float[Tensor, " B"]
    success: Bool[Tensor, " B"]
    convergence: Convergence


@full_precision
def solve_least_squares(
    residual: Residual,
    start: Tensor | Sequence[Tensor],
    inputs: Sequence[Tensor] = (),
    manifolds: Manifold | Sequence[Manifold] = "euclidean",
    weights: Float[Tensor, "#B N"] | None = None,
    mask: Bool[Tensor, "#B N"] | None = None,
    *,
    options: SolverOptions = LEAST_SQUARES_OPTIONS,
) -> LeastSquaresSolution:
    """Minimize half the sum of rho(weight * |residual|^2) over unknowns by Levenberg-Marquardt, many problems at once.

    Dense depth to dense depth, for instance, is a pose per element that depths and intrinsics have gradients through:

        def residual(T_21, depth_1, depth_2, K):  # (B, 4, 4), (B, H, W), (B, H, W), (B, 3, 3) -> (B, H W)
            points_2 = transform(T_21, backprojected(depth_1, K))
            return bilinear(depth_2, projected(points_2, K)) - points_2[..., 2]

        huber = LEAST_SQUARES_OPTIONS.replace(kernel="huber", scale=0.02)
        solution = solve_least_squares(residual, T_21, (depth_1, depth_2, K), "se3", options=huber)

    The implicit gradient is zero where the exact Hessian is not positive definite, that is, not at a strict minimum.

    Args:
        residual: function of the unknowns, then the inputs, to (B, N) or, where D numbers are robustified as one,
            (B, N, D). It is called with any part of the batch. PyTorch must be able to differentiate it in forward
            mode and twice: it cannot for `grid_sample`, it can for bilinear sums of gathered pixels.
        start: one or several unknowns, all leading with B, together of few dimensions: their Hessian is dense.
        inputs: all tensors that differ between elements, leading with B. Others, such as the parameters of a network,
            the residual may close over: they receive their gradient, too.
        manifolds: manifold of each unknown, or one for all.
        weights: inverse variances, one if None.
        mask: residuals that count, all if None; the others must be finite, with finite derivatives.
        options: how to minimize; gradients reach inputs, weights, the scale of the kernel, and what the residual
            closes over.

    Raises:
        ValueError: a shape or a dtype does not fit, a name is unknown, or the residual has gradients to tensors that
            it hides, as in torch.jit.script.
        ConvergenceError: with `options.strict`.
    """
    unknowns = (start,) if isinstance(start, Tensor) else tuple(start)
    names = (manifolds,) * len(unknowns) if isinstance(manifolds, str) else tuple(manifolds)
    product = Product.of(names, unknowns)
    (weights, counted, scale), closed_over = _checked(
        residual, unknowns, tuple(inputs), weights, mask, options.scale
    )
    tensors = (*unknowns, counted, weights, scale, *inputs)
    minimization = _Minimization(residual, product, options, tensors)
    found = find_minimum(minimization, tensors, options.backward, closed_over)
    solution, (success, *how) = found[: len(unknowns)], found[len(unknowns) :]
    convergence = Convergence(*how, limit=options.iterations)
    if options.strict:
        check_minimum(success, convergence.converged, "elements")
    if options.backward == "truncated":
        solution = minimization.last_step(solution, tensors, success)
    solution = tuple(warned(x, success, convergence, "elements") for x in solution)
    return LeastSquaresSolution(solution, convergence.cost, success, convergence)


def _checked(
    residual: Residual,
    unknowns: Tensors,
    inputs: Tensors,
    weights: Tensor | None,
    mask: Tensor | None,
    scale: Tensor | float,
) -> tuple[Tensors, list[Tensor]]:
    """Weights (B, N), which residuals count (B, N), and the scale (B,); the tensors that the residual closes over."""
    batch, like = len(unknowns[0]), unknowns[0]
    for number, tensor in enumerate((*unknowns, *inputs)):
        name = f"unknown {number}" if number < len(unknowns) else f"input {number - len(unknowns)}"
        if tensor.ndim == 0 or len(tensor) != batch:
            shape = tuple(tensor.shape)
            raise ValueError(f"{name} must lead with the batch of {batch}, not have shape {shape}")
    value, closed_over = tensors_closed_over(residual, *unknowns, *inputs)
    rows, shape = value.shape[:2], tuple(value.shape)
    if value.ndim not in (2, 3) or len(value) != batch:
        raise ValueError(f"the residual must be (B, N) or (B, N, D) with B = {batch}, not {shape}")
    weights = value.new_ones(rows) if weights is None else weights
    counted = torch.ones(rows, dtype=torch.bool, device=value.device) if mask is None else mask
    for name, tensor in (("weights", weights), ("mask", counted)):
        if tensor.shape not in (rows, (1, rows[1])):
            raise ValueError(f"{name} must be (B, N) = {tuple(rows)}, not {tuple(tensor.shape)}")
    floats = {f"input {number}": x for number, x in enumerate(inputs) if x.is_floating_point()}
    starts = {f"unknown {number}": x for number, x in enumerate(unknowns)}
    check_dtypes(**starts, **floats, residual=value, weights=weights)
    scale = kernel_scale(scale, like)
    return (weights.expand(rows), counted.expand(rows), scale.expand(batch)), closed_over


class _Model(NamedTuple):
    """The local models of the costs (B,) at unknowns: gradient (B, n) and Hessian (B, n, n) in the tangent space."""

    unknowns: Tensors
    cost: Tensor
    gradient: Tensor
    hessian: Tensor


@dataclass(frozen=True)
class _Problem:
    """The least-squares problems for `minimize_batch`, with their exact Hessians; zero weight where nothing counts."""

    residual: Residual
    product: Product
    kernel: Kernel
    counted: Tensor
    weights: Tensor
    scale: Tensor
    inputs: Tensors
    solvable: Tensor

    def part(self, rows: Tensor) -> _Problem:
        tensors = index_tree((self.counted, self.weights, self.scale, self.inputs, self.solvable), rows)
        return _Problem(self.residual, self.product, self.kernel, *tensors)

    def evaluate(self, unknowns: Tensors, use_curvature: Tensor) -> _Model:
        zero, moved = self.product.no_step(unknowns), self._moved(unknowns)
        lin = self._weighed(moved(zero), tangent.row_jacobian(moved, zero))
        # As in `gauss_newton_expansion`.
        residual, squared = lin.residual, lin.residual.square().sum(-1)
        curvature_term = flat_along(lin.weight, lin.curvature_term, squared, use_curvature[:, None])
        along = (residual[..., None, :] @ lin.J) * (curvature_term[..., None] * residual)[..., None]
        pulled = lin.weight[..., None, None] * lin.J + along
        J = lin.J.flatten(1, 2)
        hessian = J.mT @ pulled.flatten(1, 2)
        gradient = (J.mT @ lin.gradient_wrt_residual.flatten(1)[..., None]).squeeze(-1)
        return _Model(unknowns, lin.cost.sum(1), gradient, hessian)

    def step(self, model: _Model, damping: Tensor) -> tuple[Tensors, Tensor]:
        diagonal = damping[:, None] * model.hessian.diagonal(dim1=-2, dim2=-1)
        floor = diagonal_floor(damping.dtype)  # what nothing depends on stays where it is
        factor = factorize(model.hessian + torch.diag_embed(diagonal + floor), strict=False)
        step = factor.solve(model.gradient[..., None]).squeeze(-1)
        predicted_reduction = 0.5 * (step * model.gradient).sum(-1)
        predicted_reduction = torch.where(factor.definite, predicted_reduction, torch.inf)
        return self.product.retract(model.unknowns, -step), predicted_reduction

    select = staticmethod(select_models)

    def cost(self, unknowns: Tensors) -> Tensor:
        """The costs (B,)."""
        r = self._residuals(unknowns)
        return self._weighed(r, r[..., None]).cost.sum(1)

    def slope(self, unknowns: Tensors, direction: Tensor) -> Tensor:
        """The derivatives (B,) of the costs along directions (B, n)."""
        r, velocity = jvp(self._moved(unknowns), (torch.zeros_like(direction),), (direction,))[:2]
        return (self._weighed(r, velocity[..., None]).gradient_wrt_residual * velocity).sum((1, 2))

    def exact_factor(self, unknowns: Tensors) -> DefiniteFactor:
        """Of the exact Hessians (B, n, n)."""
        gradient = grad(lambda step: self.cost(self.product.retract(unknowns, step)).sum())
        return factorize(tangent.row_jacobian(gradient, self.product.no_step(unknowns)))

    def _moved(self, unknowns: Tensors) -> Callable[[Tensor], Tensor]:
        """The residuals as a function of a step (B, n)."""
        return lambda step: self._residuals(self.product.retract(unknowns, step))

    def _residuals(self, unknowns: Tensors) -> Tensor:
        """Residuals (B, N, D), zero where nothing counts."""
        r = self.residual(*unknowns, *self.inputs)
        r = r[..., None] if r.ndim == 2 else r
        return torch.where(self.counted[..., None], r, 0.0)

    def _weighed(self, residual: Tensor, J: Tensor) -> Linearization:
        weights, squared = self.weights, self.weights * residual.square().sum(-1)
        rho, slope, curvature = robustify(squared, self.kernel, self.scale[:, None])
        return Linearization(residual, J, 0.5 * rho, weights * slope, 2 * weights * weights * curvature)


class _Minimization(Minimization):
    """`minimize` for `find_minimum`; inputs are the start, then what `_Problem` has; vectors (B, n)."""

    num_vectors = 1

    def __init__(
        self, residual: Residual, product: Product, options: SolverOptions, tensors: Tensors
    ) -> None:
        self.residual, self.product, self.options = residual, product, options
        self.num_unknowns = len(product.shapes)
        inputs = tuple(tensor.ndim - 1 for tensor in tensors)
        self.ndims: tuple[Ndims, Ndims, Ndims] = (1,), (*inputs[: self.num_unknowns], 0, 0, 0, 0, 0), inputs

    def minimize(self, inputs: Tensors) -> Tensors:
        start, finite = self.product.sanitized(inputs[: self.num_unknowns])
        with torch.no_grad():
            finite = finite & torch.isfinite(self._problem(inputs).cost(start))
        problem = self._problem(inputs, finite)
        iterations, tolerance = self.options.iterations, self.options.tolerance
        model, convergence = minimize_batch(problem, start, iterations, tolerance)
        with torch.no_grad():
            success = finite & factorize(torch.where(finite[:, None, None], model.hessian, 0.0)).definite
        return *model.unknowns, success, *convergence.tensors

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        unknowns, success = found[: self.num_unknowns], found[self.num_unknowns]
        with torch.no_grad():
            factor = self._problem(inputs).exact_factor(unknowns)

        def solve(right: Tensors) -> Tensors:
            of_successes = torch.where(success[:, None], right[0], 0.0)
            return (factor.solve(of_successes[..., None]).squeeze(-1),)

        return solve

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        # A success stands in for each failure: no gradient, but finite derivatives.
        success = found[self.num_unknowns]
        rows = torch.arange(len(success), device=success.device)
        rows = torch.where(success, rows, success.long().argmax())
        found, inputs = (tuple(x.index_select(0, rows) for x in part) for part in (found, inputs))
        return self._problem(inputs).slope(found[: self.num_unknowns], direction[0]).sum()

    def retracted(self, found: Tensors, direction: Tensors) -> Tensors:
        split = self.num_unknowns
        return *self.product.retract(found[:split], direction[0]), *found[split:]

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        return self.product.push(found[: self.num_unknowns], direction[0])

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        return (self.product.pull_back(found[: self.num_unknowns], gradient),)

    def last_step(self, unknowns: Tensors, inputs: Tensors, success: Tensor) -> Tensors:
        """The unknowns after one more step from the minimum, with the gradient of that step."""
        problem = self._problem(inputs)
        last = problem.evaluate(tuple(tensor.detach() for tensor in unknowns), ~success)
        stepped, _ = problem.step(last, torch.zeros_like(last.cost))
        return where_tree(success, stepped, unknowns)

    def _problem(self, inputs: Tensors, solvable: Tensor | None = None) -> _Problem:
        counted, weights, scale, *rest = inputs[self.num_unknowns :]
        weights = torch.where(counted, weights, 0.0)
        solvable = torch.ones_like(scale, dtype=torch.bool) if solvable is None else solvable
        return _Problem(
            self.residual, self.product, self.options.kernel, counted, weights, scale, tuple(rest), solvable
        )
