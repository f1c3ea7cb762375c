"""A bundle adjustment as each differentiable solver, and Ceres, want it stated. `bundle_peers` runs them.

A formulation takes a problem and returns what solves it, and what solves it with the gradient of `loss_of` to all
pixels, if the peer has one. All fix the first two frames, stop by themselves where they can, and start alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from experiments.benchmarks.bundle import loss_of, points_loss
from experiments.benchmarks.solvers import CENTRE, FOCAL, colmap_solve
from torchslam.optim import BundleProblem, bundle_adjust

ITERATIONS = 5  # of the peers that do not stop by themselves; all have converged then
ANCHOR = 1e5  # weight of what holds theseus's first two frames, px per unit
DAMPING = 1e-4  # of theseus, the same in every iteration: our first


class Found(NamedTuple):
    """Poses (F, 4, 4), points (P, 3), the iterations, and the time of the solve where it is not all of the call."""

    T_cw: Tensor
    points_w: Tensor
    iterations: int
    solve_ms: float | None = None


class Stated(NamedTuple):
    """What solves the problem, and what gives the gradient to all pixels (M, 2) with it."""

    solve: Callable[[], Found]
    gradient: Callable[[], Tensor] | None = None


def torchslam(problem: BundleProblem) -> Stated:
    def solve() -> Found:
        solution = bundle_adjust(problem, "none", backward="detached")
        return Found(solution.T_cw, solution.points_w, int(solution.convergence.iterations))

    def gradient() -> Tensor:
        pixels = problem.pixels.clone().requires_grad_()
        loss = loss_of(bundle_adjust(replace(problem, pixels=pixels), "none"))
        return torch.autograd.grad(loss, pixels)[0]

    return Stated(solve, gradient)


def ceres(problem: BundleProblem) -> Stated:
    """As COLMAP states it: the linear solver is its choice by the number of images."""

    def solve() -> Found:
        solved = colmap_solve(problem)
        return Found(solved.T_cw, solved.points_w, solved.iterations, solved.solve_ms)

    return Stated(solve)


def pypose(problem: BundleProblem, vectorize: bool = True, sparse: bool = False) -> Stated:
    """Its Levenberg-Marquardt, which takes the whole Jacobian by autograd and changes its parameters in place."""
    import pypose as pp

    centre = torch.tensor(CENTRE, dtype=torch.float64)

    class Errors(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            start = pp.mat2SE3(problem.T_cw)
            self.held = start[:2].tensor()
            self.poses, self.points = pp.Parameter(start[2:]), nn.Parameter(problem.points_w.clone())

        def forward(self, pixels: Tensor) -> Tensor:
            poses = pp.SE3(torch.cat([self.held, self.poses.tensor()]))
            points_c = poses[problem.frame_index].Act(self.points[problem.point_index])
            return points_c[:, :2] / points_c[:, 2:] * FOCAL + centre - pixels

    def solve() -> Found:
        errors = Errors()
        strategy = pp.optim.strategy.TrustRegion(radius=1e4)
        optimizer = pp.optim.LM(errors, strategy=strategy, vectorize=vectorize, sparse=sparse)
        for _ in range(ITERATIONS):
            optimizer.step(input=problem.pixels)
        poses = pp.SE3(torch.cat([errors.held, errors.poses.tensor()])).matrix()
        return Found(poses.detach(), errors.points.detach(), ITERATIONS)

    return Stated(solve)


def pypose_rows(problem: BundleProblem) -> Stated:
    return pypose(problem, vectorize=False)


def pypose_sparse(problem: BundleProblem) -> Stated:
    return pypose(problem, sparse=True)


def theseus(problem: BundleProblem, solver: str = "CholmodSparseSolver") -> Stated:
    """Its Levenberg-Marquardt; its camera looks along -z, which turns the pixels."""
    import theseus as th

    def scalar(value: float, name: str) -> object:
        return th.Vector(tensor=torch.full((1, 1), value, dtype=torch.float64), name=name)

    objective = th.Objective(dtype=torch.float64)
    one = th.ScaleCostWeight(torch.ones(1, 1, dtype=torch.float64))
    focal, k1, k2 = scalar(FOCAL, "focal"), scalar(0.0, "k1"), scalar(0.0, "k2")
    start = {f"T{i}": T[None, :3].clone() for i, T in enumerate(problem.T_cw)}
    start |= {f"X{j}": x[None].clone() for j, x in enumerate(problem.points_w)}
    poses = [th.SE3(tensor=start[f"T{i}"], name=f"T{i}") for i in range(len(problem.T_cw))]
    points = [th.Point3(tensor=start[f"X{j}"], name=f"X{j}") for j in range(len(problem.points_w))]
    pairs = zip(problem.frame_index.tolist(), problem.point_index.tolist(), strict=True)
    for number, (i, j) in enumerate(pairs):
        reprojection = th.eb.Reprojection(
            camera_pose=poses[i],
            world_point=points[j],
            image_feature_point=th.Point2(tensor=problem.pixels[number, None], name=f"xy{number}"),
            focal_length=focal,
            calib_k1=k1,
            calib_k2=k2,
            weight=one,
            name=f"c{number}",
        )
        objective.add(reprojection)
    anchor = th.ScaleCostWeight(torch.full((1, 1), ANCHOR, dtype=torch.float64))
    for i in (0, 1):
        target = th.SE3(tensor=start[f"T{i}"], name=f"P{i}")
        objective.add(th.Difference(poses[i], target, anchor, name=f"fixed{i}"))
    optimizer = th.LevenbergMarquardt(
        objective, max_iterations=ITERATIONS, linear_solver_cls=getattr(th, solver)
    )
    layer = th.TheseusLayer(optimizer)

    def run(pixels: Tensor) -> tuple[Tensor, Tensor]:
        turned = torch.tensor(CENTRE, dtype=torch.float64) - pixels
        seen = {f"xy{number}": xy[None] for number, xy in enumerate(turned)}
        options = {"damping": DAMPING, "backward_mode": "implicit"}
        found, _ = layer.forward(start | seen, optimizer_kwargs=options)
        T_cw = torch.cat([found[f"T{i}"] for i in range(len(poses))])
        return T_cw, torch.cat([found[f"X{j}"] for j in range(len(points))])

    def solve() -> Found:
        T_cw = problem.T_cw.clone()
        with torch.no_grad():
            T_cw[:, :3], points_w = run(problem.pixels)
        return Found(T_cw, points_w, ITERATIONS)

    def gradient() -> Tensor:
        pixels = problem.pixels.clone().requires_grad_()
        return torch.autograd.grad(points_loss(run(pixels)[1]), pixels)[0]

    return Stated(solve, gradient)


def theseus_dense(problem: BundleProblem) -> Stated:
    return theseus(problem, "CholeskyDenseSolver")


def jaxls(problem: BundleProblem, solver: str = "cholmod") -> Stated:
    """Its Levenberg-Marquardt; the first solve compiles."""
    import jax
    import jax.numpy as jnp
    import jaxlie
    import jaxls as jl
    from loguru import logger

    logger.remove()
    jax.config.update("jax_enable_x64", True)
    # CHOLMOD is called back, and would wait for the one thread.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    centre, start = jnp.array(CENTRE), jaxlie.SE3.from_matrix(jnp.array(problem.T_cw.numpy()))
    frame, point = jnp.array(problem.frame_index.numpy()), jnp.array(problem.point_index.numpy())
    points_w, pixels = jnp.array(problem.points_w.numpy()), jnp.array(problem.pixels.numpy())

    se3: Any = {"default_factory": jaxlie.SE3.identity, "retract_fn": jaxlie.manifold.rplus, "tangent_dim": 6}

    class Pose(jl.Var[jaxlie.SE3], **se3): ...

    class Point(jl.Var[jax.Array], default_factory=lambda: jnp.zeros(3)): ...  # type: ignore[call-arg]

    def errors(pose: Any, x: Any, pixel: Any) -> Any:
        point_c = pose @ x
        return point_c[:2] / point_c[2] * FOCAL + centre - pixel

    @jl.Cost.factory
    def free(values: Any, pose: Any, point: Any, pixel: Any) -> Any:
        return errors(values[pose], values[point], pixel)

    @jl.Cost.factory
    def held(values: Any, pose: Any, point: Any, pixel: Any) -> Any:
        return errors(pose, values[point], pixel)

    fixed = frame < 2
    poses, points = Pose(jnp.arange(2, len(problem.T_cw))), Point(jnp.arange(len(points_w)))
    first = jl.VarValues.make([poses.with_value(jaxlie.SE3(start.wxyz_xyz[2:])), points.with_value(points_w)])

    def state(pixels: Any) -> Any:
        costs = [
            free(Pose(frame[~fixed]), Point(point[~fixed]), pixels[~fixed]),
            held(jaxlie.SE3(start.wxyz_xyz[frame[fixed]]), Point(point[fixed]), pixels[fixed]),
        ]
        return jl.LeastSquaresProblem(costs, [poses, points]).analyze()

    stated = state(pixels)

    def run(analyzed: Any) -> Any:
        return analyzed.solve(first, linear_solver=solver, verbose=False, return_summary=True)

    def solve() -> Found:
        values, summary = run(stated)
        T_cw = problem.T_cw.clone()
        T_cw[2:] = torch.tensor(jax.device_get(values[poses].as_matrix()))
        return Found(T_cw, torch.tensor(jax.device_get(values[points])), int(summary.iterations))

    def gradient() -> Tensor:
        def loss(pixels: Any) -> Any:
            found = run(state(pixels))[0][points].flatten()
            return found @ jnp.linspace(-1, 1, len(found))

        return torch.tensor(jax.device_get(jax.grad(loss)(pixels)))

    return Stated(solve, gradient)


def jaxls_iterative(problem: BundleProblem) -> Stated:
    return jaxls(problem, "conjugate_gradient")
