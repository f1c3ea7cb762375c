"""Bundle adjustment of a few frames and what they see, for every keyframe of a run: `bundle_adjust` in half the time.

The same least squares, kernel and steps, by the Schur complement on the points, but with one matrix for the coupling of
all frames with all points: of a window of a dozen frames most of it is full. As in `frame_pose`, errors are taken in
undistorted coordinates, times the slope of the distortion at the keypoint, and all is computed on the host, by numpy
and in double precision: the numbers are few, and calls are what costs. There are no gradients and no covariances.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchslam.geometry import Undistorted
from torchslam.geometry.whitening import whitening
from torchslam.optim.bundle.local_numpy_equations import LOWER, Equations, Step
from torchslam.optim.bundle.problem import BundleProblem, as_mask, checked_rows
from torchslam.optim.core.numpy_backend import (
    DAMPING,
    DAMPING_DOWN,
    DAMPING_UP,
    NEAREST,
    SLACK,
    Array,
    huber,
    moved,
    on_host,
)

_NEAR = (
    1e-2  # share of the cost that a step promises: below it the kernel's curvature counts, as of `levenberg`
)


class Adjusted(NamedTuple):
    """Poses (F, 4, 4) and points (P, 3) of least robust cost, and that cost."""

    T_cw: Tensor
    points_w: Tensor
    cost: float


def adjust_window(problem: BundleProblem, scale: float, iterations: int, tolerance: float) -> Adjusted:
    """Minimise Huber's costs of reprojection errors over the poses that are not fixed, and all points.

    problem:   one, of finite numbers and one camera, without mask, priors and fixed points
    scale:     of the kernel, in units of the whitened error
    tolerance: stop where a step promises to lower the cost by less than this share of it

    Raises ValueError for indices that do not fit, and for what it does not take.
    """
    window = _Window(problem, scale)
    model, damping, is_near = window.evaluate(window.start), DAMPING, False
    for _ in range(iterations):
        step = model.equations(is_near).step(damping, window.gauge(model.state.poses))
        if step is None:
            damping *= DAMPING_UP
            continue
        trial = window.evaluate(window.moved(model.state, step))
        promised = step.promised / model.cost if model.cost > 0 else 0.0
        is_better = trial.cost <= SLACK * model.cost
        if is_better:
            model, is_near = trial, promised < _NEAR
        damping *= DAMPING_DOWN if is_better else DAMPING_UP
        if promised <= tolerance:
            break
    return window.adjusted(model)


class _State(NamedTuple):
    """poses: (F, 3, 4) in order of slots; points: (3, P)"""

    poses: Array
    points: Array


class _Window:
    """A problem on the host: frames in slots, the free ones first, and observations by the slot of their frame.

    slot, point: (O,) whose each observation is; xy: (2, O) undistorted; along: (2, 2, O) whitened slopes, as of
    `Undistorted`; behind: (O,) the squared error of a point behind the camera, as of `residuals.weigh`
    """

    def __init__(self, problem: BundleProblem, scale: float) -> None:
        self.problem, self.scale = problem, scale
        frame, point, fixed = _rows_of(problem)
        moves = ~fixed & (np.bincount(frame, minlength=len(fixed)) > 0)
        self.order = np.argsort(~moves, kind="stable")  # of frames, by slot
        self.num_free = int(moves.sum())
        slots = np.argsort(self.order)[frame]
        by_frame = np.argsort(slots, kind="stable")
        self.slot, self.point = slots[by_frame], point[by_frame]
        counts = np.bincount(self.slot, minlength=len(fixed))
        self.anchors = (
            np.flatnonzero(counts[self.num_free :] > 0) + self.num_free
        )  # slots that see and are fixed
        self.first = (np.cumsum(counts) - counts)[: self.num_free]  # observation of each free frame
        self.linked = int(counts[: self.num_free].sum())  # observations by free frames, which come first
        self.start = _State(
            on_host(problem.T_cw)[self.order, :3], np.ascontiguousarray(on_host(problem.points_w).T)
        )
        rows = torch.from_numpy(by_frame).to(problem.frame_index.device)
        self.xy, self.along, self.behind = _observed(problem, rows)

    @cached_property
    def cells(self) -> Array:
        """(18 O',) where the entries of the observations' blocks (6, 3, O') stand in the coupling (6 F', 3 P)."""
        size, linked = self.start.points.shape[1], self.linked
        row = 6 * self.slot[:linked] + np.arange(6)[:, None]
        column = self.point[:linked] + size * np.arange(3)[:, None]
        cells: Array = (row[:, None] * (3 * size) + column[None]).reshape(-1)
        return cells

    def evaluate(self, state: _State) -> _Model:
        """The errors at a state."""
        R_cw, t = state.poses[:, :, :3], state.poses[:, :, 3:]
        centres_w = -(R_cw.transpose(0, 2, 1) @ t)
        frames = np.concatenate((R_cw.reshape(-1, 9), centres_w[..., 0]), axis=1).T
        rows = np.ascontiguousarray(frames).take(self.slot, axis=1)
        R_cw = rows[:9].reshape(3, 3, -1)
        rays_w = state.points.take(self.point, axis=1)
        rays_w -= rows[9:]
        x, y, z = (R_cw * rays_w).sum(1)
        in_front = z > NEAREST
        inverse = 1 / np.where(in_front, z, 1.0)
        image = np.stack((x * inverse, y * inverse))
        off = image - self.xy
        errors = self.along[0] * off[0] + self.along[1] * off[1]
        squared = np.where(in_front, np.square(errors).sum(0), self.behind)
        rho, influence = huber(squared, self.scale)
        seen = _Seen(R_cw, rays_w, image, inverse, errors, squared, in_front * influence)
        return _Model(self, state, 0.5 * float(rho.sum()), seen)

    def moved(self, state: _State, step: Step) -> _State:
        """A state after a step down."""
        poses = state.poses.copy()
        for slot, along_world in enumerate(step.frames.reshape(-1, 2, 3)):
            poses[slot] = moved(poses[slot], -(along_world @ poses[slot, :, :3].T).reshape(6))
        return _State(poses, state.points - step.points)

    def gauge(self, poses: Array) -> Array | None:
        """(6 F', 1 or 7) directions of the free frames, along the axes of the world, that what is fixed leaves open:
        scale, or a similarity; None where nothing is."""
        if len(self.anchors) > 1 or not self.num_free:
            return None
        centres_w = -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])
        origin, centres_w = centres_w[self.anchors[0] if len(self.anchors) else 0], centres_w[: self.num_free]
        motions = np.zeros((self.num_free, 6, 1 if len(self.anchors) else 7))
        motions[:, :3, 0] = centres_w - origin  # its sign says nothing
        if not len(self.anchors):  # all of the world moves along or turns around its axes
            motions[:, :3, 1:4] = motions[:, 3:, 4:] = np.eye(3)
            x, y, z = centres_w.T
            motions[:, 0, 5], motions[:, 0, 6] = z, -y
            motions[:, 1, 4], motions[:, 1, 6] = -z, x
            motions[:, 2, 4], motions[:, 2, 5] = y, -x
        directions: Array = np.linalg.qr(motions.reshape(6 * self.num_free, -1))[0]
        return directions

    def adjusted(self, model: _Model) -> Adjusted:
        """A model's state in the order and the type of the problem."""
        T_cw = self.problem.T_cw.detach().clone()
        T_cw[self.order[: self.num_free], :3] = torch.from_numpy(model.state.poses[: self.num_free]).to(T_cw)
        points_w = torch.from_numpy(np.ascontiguousarray(model.state.points.T)).to(self.problem.points_w)
        return Adjusted(T_cw, points_w, model.cost)


def _rows_of(problem: BundleProblem) -> tuple[Array, Array, Array]:
    """(O,), (O,) the frame and the point of each observation, and (F,) bool, which frames are fixed."""
    names = ("fixed_points", "mask", "camera_index", "pose_prior", "camera_prior")
    if problem.is_batch or any(getattr(problem, name) is not None for name in names):
        raise ValueError(f"a window is one problem, without {', '.join(names)}: use bundle_adjust")
    shape = (1, len(problem.pixels))
    frame = checked_rows("frame_index", problem.frame_index, shape, len(problem.T_cw))
    point = checked_rows("point_index", problem.point_index, shape, len(problem.points_w))
    fixed = as_mask(problem.fixed_frames, problem.T_cw[None, :, 0, 0])
    return frame[0].cpu().numpy(), point[0].cpu().numpy(), fixed[0].cpu().numpy()


def _observed(problem: BundleProblem, rows: Tensor) -> tuple[Array, Array, Array]:
    """Of observations in the order of rows (O,) what `_Window` has of them."""
    camera, pixels = problem.camera, problem.pixels[rows]
    undistorted = Undistorted.of(pixels, camera)
    weights = torch.ones_like(pixels[:, 0]) if problem.weights is None else problem.weights[rows]
    diagonal = float(camera.width**2 + camera.height**2)
    if weights.ndim == 1:
        return (
            on_host(undistorted.xy),
            on_host(undistorted.slope * weights.sqrt()),
            on_host(diagonal * weights),
        )
    along = torch.einsum("oki,jio->jko", whitening(weights), undistorted.slope)
    behind = 0.5 * diagonal * weights.diagonal(dim1=-2, dim2=-1).sum(-1)
    return on_host(undistorted.xy), np.ascontiguousarray(on_host(along)), on_host(behind)


class _Seen(NamedTuple):
    """Per observation (O): the rotation (3, 3, O) of its frame, the ray (3, O) to its point, in the axes of the world,
    where that is in the image, undistorted, (2, O), the inverse depth, the whitened errors (2, O), their square, and
    what it counts."""

    R_cw: Array
    rays_w: Array
    image: Array
    inverse: Array
    errors: Array
    squared: Array
    weight: Array


@dataclass(frozen=True)
class _Model:
    """The cost at a state, and what its equations are made of, for those who ask."""

    window: _Window
    state: _State
    cost: float
    seen: _Seen

    def equations(self, is_near: bool) -> Equations:
        """Normal equations by Gauss and Newton, with the kernel's curvature if the minimum is near: as of
        `residuals.gauss_newton_expansion` and `assembly.assemble`."""
        window, (R_cw, rays_w, image, inverse, errors, squared, weight) = self.window, self.seen
        in_image = (R_cw[:2] - image[:, None] * R_cw[2]) * inverse  # (2, 3, O)
        J = window.along[0][:, None] * in_image[0] + window.along[1][:, None] * in_image[1]
        pulled = J[0] * errors[0] + J[1] * errors[1]
        weighted = weight * J
        hessian = [weighted[0, i] * J[0, j] + weighted[1, i] * J[1, j] for i, j in LOWER]
        if is_near:  # beyond the kernel's scale the cost is flat along the error
            bent = np.where(squared > window.scale**2, -weight / squared, 0.0) * pulled
            for entry, (i, j) in zip(hessian, LOWER, strict=True):
                entry += bent[i] * pulled[j]
        slope, size = weight * pulled, self.state.points.shape[1]
        points = np.stack([np.bincount(window.point, row, size) for row in (*slope, *hessian)])

        linked = window.linked
        blocks, twice = np.empty((6, 4, linked)), np.empty((3, 3, linked))
        for entry, (i, j) in zip(hessian, LOWER, strict=True):
            blocks[i, j] = blocks[j, i] = entry[:linked]
        blocks[:3, 3] = slope[:, :linked]
        _cross(rays_w[:, :linked], blocks[:3], blocks[3:])
        _cross(rays_w[:, :linked], blocks[3:, :3].transpose(1, 0, 2), twice)
        frames = np.empty((window.num_free, 6, 6))
        sums, lower = (np.add.reduceat(x, window.first, axis=2) if linked else x for x in (blocks, twice))
        frames[:, :, :3], frames[:, :3, 3:] = sums[:, :3].transpose(2, 0, 1), sums[3:, :3].transpose(2, 1, 0)
        frames[:, 3:, 3:] = lower.transpose(2, 0, 1)
        return Equations(
            frames,
            sums[:, 3].T.copy(),
            points[3:],
            points[:3],
            blocks[:, :3],
            window.point[:linked],
            window.cells,
        )


def _cross(u: Array, columns: Array, out: Array) -> None:
    """u x every column: (3, O), (3, n, O) -> (3, n, O)."""
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(u[i], columns[j], out=out[k])
        out[k] -= u[j] * columns[i]
