"""Newton's method on the camera, through the solution of a run's graph.

The bundle adjustment of a graph has a least cost for every camera, c(theta) = min over poses and points of C(x, theta).
Its gradient is the partial derivative of C at the minimum, and its Hessian takes the *implicit* gradient of the minimum
besides: poses and points follow the camera. So every step asks the graph's solution for one backward pass per
parameter, and the same Hessian tells how well the graph determines the camera at all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchslam.geometry import Camera, transform
from torchslam.solvers.graph import GraphSolution, ObservationGraph, solve
from torchslam.solvers.robust import Kernel, robustify

KERNEL: Kernel = "huber"
SCALE = 2.45
_MAX_STEP = 0.1
_CONVERGED = 1e-5


def parameters(camera: Camera, num_radial: int) -> Tensor:
    """(1 + num_radial,) what is calibrated: the logarithm of the focal length, then k1, k2."""
    return torch.cat([camera.focal.log()[None], camera.params[4 : 4 + num_radial]])


def with_parameters(camera: Camera, theta: Tensor) -> Camera:
    """The camera with such parameters; its aspect, principal point and other coefficients stay."""
    focal = camera.params[:2] * (theta[0].exp() / camera.focal)
    return camera.with_params(
        torch.cat([focal, camera.params[2:4], theta[1:], camera.params[3 + len(theta) :]])
    )


def keyframes_of(graph: ObservationGraph) -> ObservationGraph:
    """The keyframes alone: theirs is the cost that the map minimises."""
    frames = graph.is_keyframe.nonzero().squeeze(-1)
    rows = graph.is_keyframe[graph.frame_index].nonzero().squeeze(-1)
    slots = torch.cumsum(graph.is_keyframe, 0) - 1
    return ObservationGraph(
        graph.timestamps[frames],
        graph.T_cw[frames],
        graph.points_w,
        slots[graph.frame_index[rows]],
        graph.point_index[rows],
        graph.pixels[rows],
        graph.weights[rows],
        graph.camera,
        graph.is_keyframe[frames],
    )


@dataclass(frozen=True)
class LeastCost:
    """The least cost of a graph near a camera: value (), gradient (n,), hessian (n, n), and where it is reached.

    variance: () of unit weight, from the residuals
    """

    value: Tensor
    gradient: Tensor
    hessian: Tensor
    variance: Tensor
    graph: ObservationGraph

    @property
    def standard_errors(self) -> Tensor:
        """(n,) of the parameters, as far as the errors of the pixels are independent."""
        return (self.variance * torch.linalg.inv(self.hessian).diagonal()).sqrt()


def least_cost(graph: ObservationGraph, theta: Tensor) -> LeastCost:
    """Solve a graph of keyframes with camera `theta`, and expand the least cost to second order."""
    through = theta.detach().clone().requires_grad_()  # by way of poses and points
    direct = theta.detach().clone().requires_grad_()
    solution = solve(
        replace(graph, camera=with_parameters(graph.camera, through)), KERNEL, SCALE, iterations=100
    )
    cost, count = _cost(graph, solution, with_parameters(graph.camera, direct))
    (gradient,) = torch.autograd.grad(cost, direct, create_graph=True)
    rows = [
        torch.stack(torch.autograd.grad(component, (through, direct), retain_graph=True)).sum(0)
        for component in gradient
    ]
    hessian = torch.stack(rows)
    moved = 6 * (len(graph.T_cw) - 1) + 3 * int(solution.moved_points.sum())
    return LeastCost(
        cost.detach(),
        gradient.detach(),
        0.5 * (hessian + hessian.mT),
        2 * cost.detach() / (2 * count - moved),
        replace(
            graph,
            T_cw=solution.T_cw.detach(),
            points_w=solution.points_w.detach(),
            camera=with_parameters(graph.camera, theta.detach()),
        ),
    )


def _cost(graph: ObservationGraph, solution: GraphSolution, camera: Camera) -> tuple[Tensor, int]:
    """Half the sum of the robust squared reprojection errors, as `bundle_adjust` has it, and how many count."""
    counted = solution.moved_points[graph.point_index]
    frames, points = graph.frame_index[counted], graph.point_index[counted]
    points_c = transform(solution.T_cw[frames], solution.points_w[points][:, None])
    pixels, valid = camera.project(points_c)
    squared = graph.weights[counted] * (pixels[:, 0] - graph.pixels[counted]).square().sum(-1)
    rho = robustify(squared, KERNEL, squared.new_tensor(SCALE)).rho
    behind = float(camera.width**2 + camera.height**2)
    return 0.5 * torch.where(valid[:, 0], rho, behind).sum(), int(counted.sum())


def calibrate(graph: ObservationGraph, num_radial: int = 0, steps: int = 20) -> LeastCost:
    """The camera under which the keyframes of a graph cost least, started at the graph's own.

    num_radial: how many coefficients of the distortion are calibrated beside the focal length.
    Newton's method; directions in which the cost bends downwards count as if it bent upwards, and a step that raises
    the cost is halved.
    """
    theta = parameters(graph.camera, num_radial)
    here = least_cost(keyframes_of(graph), theta)
    for _ in range(steps):
        step = _newton_step(here)
        if step.abs().max() < _CONVERGED:
            break
        for _ in range(6):
            there = least_cost(here.graph, theta + step)
            if there.value <= here.value:
                break
            step = 0.5 * step
        else:
            break
        theta, here = theta + step, there
    return here


def _newton_step(cost: LeastCost) -> Tensor:
    """Downhill, no parameter further than `_MAX_STEP`."""
    bends, directions = torch.linalg.eigh(cost.hessian)
    step = -directions @ ((directions.mT @ cost.gradient) / bends.abs().clamp_min(1e-12 * bends.abs().max()))
    return step * (_MAX_STEP / step.abs().max()).clamp_max(1.0)
