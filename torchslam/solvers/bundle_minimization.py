"""A bundle adjustment as `implicit.minimum` takes it: in the order of the problem, whatever the layout's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.solvers.bundle_model import Bundle, Estimate, Inputs, Layout, build_layout
from torchslam.solvers.folding import Tensors
from torchslam.solvers.implicit import Ndims
from torchslam.solvers.levenberg import Progress, minimize
from torchslam.solvers.residuals import Observations, linearize
from torchslam.solvers.robust import Kernel
from torchslam.solvers.schur import Marginals, Tangent
from torchslam.solvers.tangent import move, pull_back, push, retract


class Found(NamedTuple):
    """The estimate, what moved (F,), (P,), what counted (O,), and how it went."""

    T_cw: Tensor
    points_w: Tensor
    params: Tensor
    success: Tensor
    moved_frames: Tensor
    moved_points: Tensor
    used: Tensor
    cost: Tensor
    iterations: Tensor
    converged: Tensor
    initial_cost: Tensor

    @property
    def estimate(self) -> Estimate:
        return Estimate(self.T_cw, self.points_w, self.params)


class Given(NamedTuple):
    """All that a bundle adjustment is made of: the tensors of `bundle_model.Inputs`, which observations count (O,) and
    which frames are finite (F,), and the rows of `BundleProblem` and what may move, (F,), (P,)."""

    T_cw: Tensor
    points_w: Tensor
    pixels: Tensor
    weights: Tensor
    params: Tensor
    scale: Tensor
    counted: Tensor
    finite_frames: Tensor
    frame_index: Tensor
    point_index: Tensor
    free_frames: Tensor
    free_points: Tensor


class BundleMinimization:
    """A bundle adjustment of inputs `Given`; vectors are frames (F, 6), points (P, 3) and camera (K,): n along the
    directions (K, n) in which it may move, none where it is fixed."""

    num_unknowns = 3
    num_vectors = 3
    ndims: tuple[Ndims, Ndims, Ndims] | None = None

    def __init__(
        self,
        camera: Camera,
        kernel: Kernel,
        free_camera: bool | Tensor,
        iterations: int,
        tolerance: float,
        progress: Progress | None,
        check: bool = True,
    ) -> None:
        self.camera, self.kernel, self.free_camera = camera, kernel, free_camera is not False
        self.directions = free_camera if isinstance(free_camera, Tensor) else None
        self.iterations, self.tolerance, self.progress = iterations, tolerance, progress
        self.check = check
        self._last: tuple[Tensor, Layout] | None = None

    def minimize(self, inputs: Tensors) -> Found:
        given = Given(*inputs)
        bundle = self._bundle(given)
        layout = bundle.layout
        model, convergence = minimize(bundle, bundle.start, self.iterations, self.tolerance, self.progress)
        with torch.no_grad():
            success = bundle.solvable[0] & given.finite_frames.all()
            if self.check:
                success = success & bundle.factorized(model).reduced.definite
        moved_frames = torch.zeros_like(given.free_frames)
        moved_frames[layout.free_frames] = True
        used = torch.zeros_like(given.counted)
        used[layout.observations] = True
        T_cw, points_w, params = model.estimate
        return Found(
            T_cw,
            points_w[layout.point_rank],
            params,
            success,
            moved_frames,
            layout.free_points[layout.point_rank],
            used,
            convergence.cost[0],
            convergence.iterations,
            convergence.converged,
            convergence.initial_cost,
        )

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        found = Found(*found)
        bundle = self._bundle(Given(*inputs))
        layout = bundle.layout
        with torch.no_grad():
            solver = bundle.exact_solver(self._ordered(found, layout))

        def solve(right: Tensors) -> Tensors:
            frames, points, camera = right
            tangent = Tangent(
                frames.index_select(0, layout.free_frames), points.index_select(0, layout.point_order), camera
            )
            solved = solver(tangent)
            spread = torch.zeros_like(frames).index_copy(0, layout.free_frames, solved.frames)
            vector = spread, solved.points.index_select(0, layout.point_rank), solved.camera
            return tuple(torch.where(found.success, part, 0.0) for part in vector)

        return solve

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        frames, points, camera = direction
        found, given = Found(*found), Given(*inputs)
        T_cw, points_w, params = self.at_minimum(found, given)
        T_cw = T_cw.index_select(0, given.frame_index)
        points_c = (T_cw[:, :3, :3] @ points_w.index_select(0, given.point_index)[..., None]).squeeze(-1)
        points_c = points_c + T_cw[:, :3, 3]
        weights = torch.where(found.used, given.weights, 0.0)
        observed = Observations(
            given.pixels, weights, self.camera.with_params(params), self.kernel, given.scale
        )
        lin = linearize(observed, points_c, self.free_camera)
        velocity = move(points_c, frames.index_select(0, given.frame_index))
        moving = points.index_select(0, given.point_index)[..., None]
        velocity = velocity + (T_cw[:, :3, :3] @ moving).squeeze(-1)
        if self.free_camera:
            velocity = torch.cat((velocity, self._along(camera).expand(len(velocity), -1)), dim=-1)
        return (lin.force[:, None, :] @ lin.J @ velocity[..., None]).sum()

    def moved(self, found: Tensors, direction: Tensors) -> Tensors:
        frames, points, camera = direction
        T_cw, points_w, params, *rest = found
        params = params + self._along(camera) if self.free_camera else params
        return retract(T_cw, frames), points_w + points, params, *rest

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        frames, points, camera = direction
        return (
            push(found[0], frames),
            points,
            self._along(camera) if self.free_camera else torch.zeros_like(found[2]),
        )

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        frames, points, params = gradient
        return pull_back(found[0], frames), points, self._across(params) if self.free_camera else params[:0]

    def _along(self, step: Tensor) -> Tensor:
        """(K,) how a step changes the camera's parameters."""
        return step if self.directions is None else self.directions @ step

    def _across(self, gradient: Tensor) -> Tensor:
        """Of a gradient in the camera's parameters (K,), what steps can follow."""
        return gradient if self.directions is None else gradient @ self.directions

    def at_minimum(self, found: Found, inputs: Given) -> Estimate:
        """The minimum where things moved, the inputs, with their derivatives, where they did not."""
        params = found.params if self.free_camera else inputs.params
        if self.directions is not None:  # what does not move of the parameters reaches them unchanged
            params = params + (inputs.params - inputs.params.detach())
        return Estimate(
            torch.where(found.moved_frames[:, None, None], found.T_cw, inputs.T_cw),
            torch.where(found.moved_points[:, None], found.points_w, inputs.points_w),
            params,
        )

    def last_step(self, found: Found, inputs: Tensors) -> Estimate:
        """The estimate after one more step from the minimum, with the gradient of that step."""
        bundle = self._bundle(Given(*inputs))
        start = self._ordered(self.at_minimum(found, Given(*inputs)), bundle.layout)
        model = bundle.evaluate(start, ~bundle.solvable)
        solution, _ = bundle.step(model, torch.zeros_like(model.cost))
        return solution._replace(points_w=solution.points_w[bundle.layout.point_rank])

    def marginals(self, found: Found, inputs: Sequence[Tensor]) -> Marginals:
        with torch.no_grad():
            bundle = self._bundle(Given(*inputs))
            return bundle.marginals(self._ordered(found, bundle.layout))

    def _ordered(self, estimate: Found | Estimate, layout: Layout) -> Estimate:
        return Estimate(estimate.T_cw, estimate.points_w.index_select(0, layout.point_order), estimate.params)

    def _bundle(self, given: Given) -> Bundle:
        free_camera = self.free_camera if self.directions is None else self.directions
        return Bundle(self._layout(given), Inputs(*given[:6]), self.camera, self.kernel, free_camera)

    def _layout(self, given: Given) -> Layout:
        """The layout for the observations that count; the last one is kept, which mostly is the next one."""
        if self._last is None or not torch.equal(self._last[0], given.counted):
            layout = build_layout(
                given.frame_index, given.point_index, given.counted, given.free_frames, given.free_points
            )
            self._last = given.counted, layout
        return self._last[1]
