"""A pose graph as `implicit.minimum` takes it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchslam.geometry.robust import Kernel
from torchslam.optim.core.batching import Tensors
from torchslam.optim.core.implicit import Ndims
from torchslam.optim.core.levenberg_marquardt import minimize
from torchslam.optim.pose_graph.layout import Layout, build_layout
from torchslam.optim.pose_graph.model import Inputs, PoseGraphProblem, linearize, pull_back, push, retract


class PoseGraphMinimization:
    """A pose graph; its inputs are those of `pose_graph_model.Inputs`, edges that count (B, E), fixed nodes (B, K), and
    the edges (E, 2).

    Found are the nodes (B, K, 4, 4), `success` (B,), what moved (B, K), and how it went; vectors are (B, K, D).
    """

    num_unknowns = 1
    num_vectors = 1
    ndims: tuple[Ndims, Ndims, Ndims] | None = ((2,), (3, 0, 1, 0, 0, 0, 0), (3, 3, 3, 1, 1, 1, 2))

    def __init__(self, dims: int, kernel: Kernel, iterations: int, tolerance: float) -> None:
        self.dims, self.kernel = dims, kernel
        self.iterations, self.tolerance = iterations, tolerance
        self._last: tuple[tuple[Tensor, Tensor], Layout] | None = None

    def minimize(self, inputs: Tensors) -> Tensors:
        problem = self._problem(inputs)
        model, convergence = minimize(problem, inputs[0], self.iterations, self.tolerance)
        with torch.no_grad():
            success = problem.solvable & problem.factorized(model).definite
        how = convergence.iterations, convergence.converged, convergence.initial_cost
        return model.S_cw, success, problem.layout.moving, convergence.cost, *how

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        S_cw, success, moving, *_ = found
        problem, use = self._problem(inputs), (moving & success[:, None])[..., None]
        with torch.no_grad():
            factor = problem.factorized(problem.exact_model(S_cw))

        def solve(right: Tensors) -> Tensors:
            return (torch.where(use, factor.solve(torch.where(use, right[0], 0.0)), 0.0),)

        return solve

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        given, (xi,), (i, j) = Inputs(*inputs[:4]), direction, inputs[6].unbind(-1)
        S_cw = torch.where(found[2][..., None, None], found[0], given.S_cw)
        lin = linearize(S_cw, i, j, inputs[4], given, self.kernel)
        xi_i, xi_j = xi.index_select(1, i)[..., None], xi.index_select(1, j)[..., None]
        velocity = (lin.J @ (xi_j - lin.carry @ xi_i)).squeeze(-1)
        return (lin.kernel.weight * (lin.pull * velocity).sum(-1)).sum()

    def moved(self, found: Tensors, direction: Tensors) -> Tensors:
        return retract(found[0], direction[0]), *found[1:]

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        return (push(found[0], direction[0]),)

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        return (pull_back(found[0], gradient[0])[..., : self.dims],)

    def last_step(self, S_cw: Tensor, inputs: Tensors, success: Tensor) -> Tensor:
        """The nodes after one more step from the minimum, with the gradient of that step."""
        problem = self._problem(inputs)
        last = problem.evaluate(S_cw, ~success)
        return problem.step(last, torch.zeros_like(last.cost))[0]

    def _problem(self, inputs: Tensors) -> PoseGraphProblem:
        return PoseGraphProblem(self._layout(*inputs[4:]), Inputs(*inputs[:4]), self.kernel)

    def _layout(self, counted: Tensor, fixed: Tensor, edges: Tensor) -> Layout:
        """The layout for what counts and is fixed; the last one is kept, which mostly is the next one."""
        key = counted, fixed
        if self._last is None or not all(map(torch.equal, self._last[0], key)):
            self._last = key, build_layout(edges, counted, fixed, self.dims)
        return self._last[1]
