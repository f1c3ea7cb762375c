"""Compare the gradient of a loss on a solved graph with differences of solutions, which are easily taken wrong.

Differences of a default solution say nothing: it stops where the cost hardly falls, and its poses are then off by more
than the step moves them. Here the search ends at rounding, starts from the solution without the step, and two steps
are extrapolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.lie import rigid, so3_exp
from torchslam.optim._core.levenberg_marquardt import GRAPH_OPTIONS, SolverOptions
from torchslam.optim.observation_graph import ObservationGraph
from torchslam.optim.run_graph import GraphSolution, solve_graph

Loss = Callable[[GraphSolution], Tensor]

CHECK_TOLERANCE = 1e-20
"""Of the searches: the poses are then exact to some 1e-10 of their standard deviation. Tried from 1e-10, where
differences are off by up to a quarter, to 0, where every search takes all iterations."""
_CAMERA_UNIT = 0.01
"""Share of the camera's parameters that counts as much as a pixel. Tried at this value and at 1, where differences of
a run are 3e-4 off."""
GAUGE = "translation x", "translation y", "translation z", "rotation x", "rotation y", "rotation z", "scale"
GAUGE_TOLERANCE = 1e-6
"""Change of a loss, as a share of it, by a motion of the world of one unit (or radian, or by the factor e) from which
on it counts as dependent on the gauge: aligned errors change by rounding, 1e-12. Tried at this value only."""


@dataclass(frozen=True)
class GradientCheck:
    """Slopes of a loss along random directions of its inputs, and of the gauge.

    Attributes:
        names: the input of each direction.
        analytic: slope by the gradient; numeric: by differences of solutions.
        uncertainty: of the differences, by what their extrapolation changes.
        gauge: change of the loss with each motion of the world in `GAUGE`, as a share of the loss; the largest of all
            submaps.
    """

    names: tuple[str, ...]
    analytic: Float[Tensor, " D"]
    numeric: Float[Tensor, " D"]
    uncertainty: Float[Tensor, " D"]
    gauge: Float[Tensor, " 7"]

    @property
    def errors(self) -> Float[Tensor, " D"]:
        """Difference of both slopes, relative to the larger one."""
        larger = torch.maximum(self.analytic.abs(), self.numeric.abs())
        return (self.analytic - self.numeric).abs() / larger.clamp_min(torch.finfo(larger.dtype).tiny)

    @property
    def depends_on(self) -> tuple[str, ...]:
        """The motions of the world that change the loss. Where no factor, depth or prior determines them, they are
        those of the start, and the gradient of the loss depends on an arbitrary choice: align the loss (`ate`,
        `rpe`), or add such factors."""
        rows = zip(GAUGE, self.gauge.tolist(), strict=True)
        return tuple(name for name, slope in rows if abs(slope) > GAUGE_TOLERANCE)

    def __str__(self) -> str:
        rows = zip(self.names, self.analytic, self.numeric, self.errors, self.uncertainty, strict=True)
        lines = ["input       gradient     differences  relative error  uncertainty"]
        for name, *values, uncertainty in rows:
            own, other, error = map(float, values)
            lines.append(f"{name:10} {own:12.5e} {other:12.5e}    {error:8.1e}     {float(uncertainty):8.1e}")
        if self.depends_on:
            lines.append(
                f"the loss depends on the gauge ({', '.join(self.depends_on)}): align it, or let factors determine it"
            )
        return "\n".join(lines)


def check_gradient(
    graph: ObservationGraph,
    loss: Loss,
    inputs: Sequence[str] = ("pixels", "weights", "camera"),
    *,
    directions: int = 2,
    step: float = 1e-3,
    seed: int = 0,
    options: SolverOptions = GRAPH_OPTIONS,
    **given: Any,
) -> GradientCheck:
    """Compare the gradient of a loss of `solve_graph(graph)` with central differences of solutions.

    Args:
        loss: function of the solution to a number.
        inputs: of "pixels", "weights" and "camera". The camera's parameters are those of the calibration where the
            graph has one.
        directions: number of random ones for each input.
        step: length of the differences, in pixels, relative to weights, or in hundredths of the camera's parameters.
        options: as of `solve_graph`, but for the tolerance.
        given: other arguments of `solve_graph`, such as factors.

    Returns:
        The slopes, also along the gauge; it prints as a table.

    Raises:
        ValueError: an input is unknown.
        ConvergenceError: a search did not end at a minimum, with `options.strict`.
    """
    options = options.replace(tolerance=min(options.tolerance, CHECK_TOLERANCE))
    values = {name: _value(graph, name).detach().clone() for name in inputs}
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    solution = solve_graph(_with(graph, leaves), options=options, **given)
    value = loss(solution)
    gradients = torch.autograd.grad(value, list(leaves.values()), allow_unused=True, materialize_grads=True)
    generator = torch.Generator().manual_seed(seed)

    @torch.no_grad()
    def moved(name: str, change: Tensor) -> Tensor:
        more = {**given, "start": solution}
        return loss(
            solve_graph(_with(graph, values | {name: values[name] + change}), options=options, **more)
        )

    names, slopes = [], []
    for name, gradient in zip(inputs, gradients, strict=True):
        size_of = {"weights": values[name].abs(), "camera": _CAMERA_UNIT * values[name].abs()}
        unit = size_of.get(name, torch.ones_like(gradient))
        for _ in range(directions):
            noise = torch.randn(gradient.shape, generator=generator, dtype=torch.float64, device="cpu")
            along = unit * noise.to(gradient)
            wide, narrow = (
                (moved(name, size * along) - moved(name, -size * along)) / (2 * size)
                for size in (step, 0.5 * step)
            )
            numeric = (4 * narrow - wide) / 3
            names.append(name)
            slopes.append(torch.stack(((gradient * along).sum(), numeric, (numeric - narrow).abs())).detach())
    analytic, numeric, uncertainty = torch.stack(slopes).unbind(-1)
    return GradientCheck(tuple(names), analytic, numeric, uncertainty, _gauge_slopes(solution, loss))


def _value(graph: ObservationGraph, name: str) -> Tensor:
    if name == "camera":
        return (graph.camera if graph.calibration is None else graph.calibration.camera).params
    if name not in ("pixels", "weights"):
        raise ValueError(f"unknown input {name!r}; known are pixels, weights, camera")
    value: Tensor = getattr(graph, name)
    return value


def _with(graph: ObservationGraph, values: dict[str, Tensor]) -> ObservationGraph:
    changes: dict[str, Any] = dict(values)
    if "camera" in changes:
        params = changes.pop("camera")
        if graph.calibration is None:
            changes["camera"] = graph.camera.with_params(params)
        else:
            camera = graph.calibration.camera.with_params(params)
            changes["calibration"] = replace(graph.calibration, camera=camera)
    return replace(graph, **changes)


def _gauge_slopes(solution: GraphSolution, loss: Loss) -> Float[Tensor, " 7"]:
    """As of `GradientCheck.gauge`."""
    T_cw, points_w = solution.T_cw.detach(), solution.points_w.detach()
    slopes = []
    for submap in torch.unique(solution.submap):
        xi = T_cw.new_zeros(7, requires_grad=True)
        scale, R = xi[6].exp(), so3_exp(xi[3:6])
        R_cw = T_cw[:, :3, :3] @ R.mT
        turned = rigid(R_cw, scale * T_cw[:, :3, 3] - (R_cw @ xi[:3]))
        moved = torch.where((solution.submap == submap)[:, None, None], turned, T_cw)
        value = loss(replace(solution, T_cw=moved, points_w=scale * points_w @ R.mT + xi[:3]))
        (slope,) = torch.autograd.grad(value, xi, allow_unused=True, materialize_grads=True)
        slopes.append((slope / value.abs().clamp_min(torch.finfo(value.dtype).tiny)).detach())
    every = torch.stack(slopes)
    return every.gather(0, every.abs().argmax(0, keepdim=True))[0]
