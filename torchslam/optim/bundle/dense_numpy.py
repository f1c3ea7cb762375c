"""The dense formulation of a bundle adjustment by NumPy: one problem, such as the local map of every keyframe.

`_dense` is the same formulation by PyTorch, for batches and with gradients: frames move along the axes of the world,
the free ones come first, and the Schur complement on the points is one dense matrix, since most of a local window of a
dozen frames is filled. NumPy takes half of the time
for one problem, and has neither gradients nor covariances.

They differ in the residual of a distorted camera: as in `frame_pose`, errors here are taken in undistorted coordinates
and multiplied with the slope of the distortion at the keypoint, which is exact for pinhole cameras and to first order
for others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import UndistortedKeypoints
from torchslam.geometry.gating import whitening
from torchslam.optim._core.linear import LOWER_3X3, diagonal_floor, inverse_root_3x3, lower_times, upper_times
from torchslam.optim._core.numpy_backend import (
    MIN_DEPTH,
    Array,
    cross_columns,
    huber,
    minimize_model,
    retract_pose,
    solve_symmetric,
    to_numpy,
)
from torchslam.optim.bundle._problem import BundleProblem, checked_rows
from torchslam.utils.indexing import row_mask


class NumpyBundleSolution(NamedTuple):
    """Poses (K, 4, 4) and points (N, 3) of minimal robust cost, and that cost."""

    T_cw: Float[Tensor, "K 4 4"]
    points_w: Float[Tensor, "N 3"]
    cost: float


def solve_bundle_numpy(
    problem: BundleProblem, scale: float, iterations: int, tolerance: float
) -> NumpyBundleSolution:
    """Minimize Huber costs of reprojection errors over all points and the poses that are not fixed.

    problem: a single one, finite, with one camera, and without mask, priors and fixed points; scale: of the kernel, in
    units of the whitened error; iterations and tolerance as of `minimize_model`. Raises ValueError where an index is
    out of range, or the problem has a part that is not supported.
    """
    bundle = _Bundle(problem, scale)
    model = minimize_model(bundle.evaluate(bundle.start), bundle.evaluate, iterations, tolerance)
    return bundle.solution(model)


class _Estimate(NamedTuple):
    """poses: (K, 3, 4) in order of slots; points: (3, N)"""

    poses: Array
    points: Array


class _Bundle:
    """A problem as arrays: frames in slots, the free ones first, and observations ordered by the slot of their frame.

    slot, point: (O,) frame slot and point of each observation
    xy:          (2, O) undistorted keypoints; along: (2, 2, O) whitened slopes, as in `UndistortedKeypoints`
    behind:      (O,) squared error of a point behind the camera, as in `residuals.weigh`
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
        # Slots of the fixed frames that have observations.
        self.anchors = np.flatnonzero(counts[self.num_free :] > 0) + self.num_free
        self.first = (np.cumsum(counts) - counts)[: self.num_free]  # observation of each free frame
        self.linked = int(counts[: self.num_free].sum())  # observations by free frames, which come first
        self.start = _Estimate(
            to_numpy(problem.T_cw)[self.order, :3], np.ascontiguousarray(to_numpy(problem.points_w).T)
        )
        rows = torch.from_numpy(by_frame).to(problem.frame_index.device)
        self.xy, self.along, self.behind = _observed(problem, rows)

    @cached_property
    def cells(self) -> Array:
        """Flat position (18 O',) in the coupling (6 K', 3 N) of each entry of the observations' blocks (6, 3, O')."""
        size, linked = self.start.points.shape[1], self.linked
        row = 6 * self.slot[:linked] + np.arange(6)[:, None]
        column = self.point[:linked] + size * np.arange(3)[:, None]
        cells: Array = (row[:, None] * (3 * size) + column[None]).reshape(-1)
        return cells

    def evaluate(self, estimate: _Estimate) -> _Model:
        """The errors at an estimate."""
        R_cw, t = estimate.poses[:, :, :3], estimate.poses[:, :, 3:]
        centers_w = -(R_cw.transpose(0, 2, 1) @ t)
        frames = np.concatenate((R_cw.reshape(-1, 9), centers_w[..., 0]), axis=1).T
        rows = np.ascontiguousarray(frames).take(self.slot, axis=1)
        R_cw = rows[:9].reshape(3, 3, -1)
        rays_w = estimate.points.take(self.point, axis=1)
        rays_w -= rows[9:]
        x, y, z = (R_cw * rays_w).sum(1)
        in_front = z > MIN_DEPTH
        inverse = 1 / np.where(in_front, z, 1.0)
        image = np.stack((x * inverse, y * inverse))
        off = image - self.xy
        errors = self.along[0] * off[0] + self.along[1] * off[1]
        squared = np.where(in_front, np.square(errors).sum(0), self.behind)
        rho, influence = huber(squared, self.scale)
        lin = _Linearization(R_cw, rays_w, image, inverse, errors, squared, in_front * influence)
        return _Model(self, estimate, 0.5 * float(rho.sum()), lin)

    def retract(self, estimate: _Estimate, step: _Step) -> _Estimate:
        """The estimate after subtracting a step."""
        poses = estimate.poses.copy()
        for slot, along_world in enumerate(step.frames.reshape(-1, 2, 3)):
            poses[slot] = retract_pose(poses[slot], -(along_world @ poses[slot, :, :3].T).reshape(6))
        return _Estimate(poses, estimate.points - step.points)

    def gauge(self, poses: Array) -> Array | None:
        """Gauge directions (6 K', 1 or 7) of the free frames, along the axes of the world: the scale where one frame is
        fixed, a similarity where none is; None where more frames are."""
        if len(self.anchors) > 1 or not self.num_free:
            return None
        centers_w = -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])
        origin, centers_w = centers_w[self.anchors[0] if len(self.anchors) else 0], centers_w[: self.num_free]
        motions = np.zeros((self.num_free, 6, 1 if len(self.anchors) else 7))
        motions[:, :3, 0] = centers_w - origin  # its sign is arbitrary
        if not len(self.anchors):  # translations along and rotations about the axes of the world
            motions[:, :3, 1:4] = motions[:, 3:, 4:] = np.eye(3)
            x, y, z = centers_w.T
            motions[:, 0, 5], motions[:, 0, 6] = z, -y
            motions[:, 1, 4], motions[:, 1, 6] = -z, x
            motions[:, 2, 4], motions[:, 2, 5] = y, -x
        directions: Array = np.linalg.qr(motions.reshape(6 * self.num_free, -1))[0]
        return directions

    def solution(self, model: _Model) -> NumpyBundleSolution:
        """The estimate of a model in the order and the dtype of the problem."""
        T_cw = self.problem.T_cw.detach().clone()
        free = torch.from_numpy(model.estimate.poses[: self.num_free])
        T_cw[self.order[: self.num_free], :3] = free.to(T_cw)
        points_w = torch.from_numpy(np.ascontiguousarray(model.estimate.points.T)).to(self.problem.points_w)
        return NumpyBundleSolution(T_cw, points_w, model.cost)


def _rows_of(problem: BundleProblem) -> tuple[Array, Array, Array]:
    """Frame and point of each observation, (O,) twice, and the mask (K,) of the fixed frames."""
    names = ("fixed_points", "mask", "camera_index", "pose_prior", "camera_prior", "depth_prior")
    if problem.is_batch or problem.factors or any(getattr(problem, name) is not None for name in names):
        raise ValueError(
            f"the NumPy backend takes one problem without {', '.join(names)} and factors: use solve_bundle"
        )
    shape = (1, len(problem.pixels))
    frame = checked_rows("frame_index", problem.frame_index, shape, len(problem.T_cw))
    point = checked_rows("point_index", problem.point_index, shape, len(problem.points_w))
    fixed = row_mask("fixed_frames", problem.fixed_frames, problem.T_cw[None, :, 0, 0])
    return frame[0].cpu().numpy(), point[0].cpu().numpy(), fixed[0].cpu().numpy()


def _observed(problem: BundleProblem, rows: Tensor) -> tuple[Array, Array, Array]:
    """`xy`, `along` and `behind` of `_Bundle`, for observations in the order of rows (O,)."""
    camera, pixels = problem.camera, problem.pixels[rows]
    undistorted = UndistortedKeypoints.of(pixels, camera)
    weights = torch.ones_like(pixels[:, 0]) if problem.weights is None else problem.weights[rows]
    diagonal = float(camera.width**2 + camera.height**2)
    if weights.ndim == 1:
        along, behind = undistorted.slope * weights.sqrt(), diagonal * weights
    else:
        along = torch.einsum("oki,jio->jko", whitening(weights), undistorted.slope)
        behind = 0.5 * diagonal * weights.diagonal(dim1=-2, dim2=-1).sum(-1)
    return to_numpy(undistorted.xy), np.ascontiguousarray(to_numpy(along)), to_numpy(behind)


class _Linearization(NamedTuple):
    """Per observation: the rotation (3, 3, O) of its frame, the ray (3, O) from the camera to the point along the axes
    of the world, its undistorted projection (2, O), inverse depth, whitened error (2, O), squared error, and weight."""

    R_cw: Array
    rays_w: Array
    image: Array
    inverse: Array
    errors: Array
    squared: Array
    weight: Array


@dataclass(frozen=True)
class _Model:
    """The cost at an estimate; its equations are assembled for a step only."""

    bundle: _Bundle
    estimate: _Estimate
    cost: float
    linearization: _Linearization

    def step(self, damping: float, use_curvature: bool) -> tuple[_Estimate, float] | None:
        """As `LocalModel.step`."""
        bundle = self.bundle
        step = self._equations(use_curvature).step(damping, bundle.gauge(self.estimate.poses))
        return None if step is None else (bundle.retract(self.estimate, step), step.predicted_reduction)

    def _equations(self, use_curvature: bool) -> _Equations:
        """Gauss-Newton normal equations, optionally with the kernel's curvature, as in
        `residuals.gauss_newton_expansion` and `bundle._sparse.assemble_sparse`."""
        bundle, (R_cw, rays_w, image, inverse, errors, squared, weight) = self.bundle, self.linearization
        in_image = (R_cw[:2] - image[:, None] * R_cw[2]) * inverse  # (2, 3, O)
        J = bundle.along[0][:, None] * in_image[0] + bundle.along[1][:, None] * in_image[1]
        residual_gradient = J[0] * errors[0] + J[1] * errors[1]
        weighted = weight * J
        hessian = [weighted[0, i] * J[0, j] + weighted[1, i] * J[1, j] for i, j in LOWER_3X3]
        if use_curvature:  # beyond the kernel's scale the cost is flat along the error
            curvature = np.where(squared > bundle.scale**2, -weight / squared, 0.0) * residual_gradient
            for entry, (i, j) in zip(hessian, LOWER_3X3, strict=True):
                entry += curvature[i] * residual_gradient[j]
        slope, size = weight * residual_gradient, self.estimate.points.shape[1]
        points = np.stack([np.bincount(bundle.point, row, size) for row in (*slope, *hessian)])

        linked = bundle.linked
        blocks, twice = np.empty((6, 4, linked)), np.empty((3, 3, linked))
        for entry, (i, j) in zip(hessian, LOWER_3X3, strict=True):
            blocks[i, j] = blocks[j, i] = entry[:linked]
        blocks[:3, 3] = slope[:, :linked]
        cross_columns(rays_w[:, :linked], blocks[:3], blocks[3:])
        cross_columns(rays_w[:, :linked], blocks[3:, :3].transpose(1, 0, 2), twice)
        frames = np.empty((bundle.num_free, 6, 6))
        sums, lower = (np.add.reduceat(x, bundle.first, axis=2) if linked else x for x in (blocks, twice))
        frames[:, :, :3], frames[:, :3, 3:] = sums[:, :3].transpose(2, 0, 1), sums[3:, :3].transpose(2, 1, 0)
        frames[:, 3:, 3:] = lower.transpose(2, 0, 1)
        return _Equations(bundle, frames, sums[:, 3].T.copy(), points[3:], points[:3], blocks[:, :3])


class _Step(NamedTuple):
    """Steps of the free frames (K', 6), along the axes of the world, and of the points (3, N)."""

    frames: Array
    points: Array
    predicted_reduction: float


@dataclass(frozen=True)
class _Equations:
    """Normal equations of frames that move along the axes of the world, as in `bundle._sparse`, and of points.

    frames: (K', 6, 6), frames_gradient: (K', 6); points: (6, N) as `LOWER_3X3`, points_gradient: (3, N)
    blocks: (6, 3, O') of observations by free frames, frame against point
    """

    bundle: _Bundle
    frames: Array
    frames_gradient: Array
    points: Array
    points_gradient: Array
    blocks: Array

    def step(self, damping: float, gauge: Array | None) -> _Step | None:
        """The step to the minimum of the damped model; None where there is none.

        gauge: (6 K', g) directions of the frames along which the step is zero
        """
        damped = self.points.copy()
        damped[[0, 2, 5]] *= 1 + damping
        root = np.stack(inverse_root_3x3(damped))
        halves = np.stack(lower_times(root, self.points_gradient))
        num_free = len(self.frames)
        if not num_free:
            points = np.stack(upper_times(root, halves))
            return _Step(np.zeros((0, 6)), points, 0.5 * float((points * self.points_gradient).sum()))
        coupling = self._coupling(root)
        reduced = -(coupling @ coupling.T)
        damped = self.frames.copy()
        damped.reshape(-1, 36)[:, ::7] *= 1 + damping
        damped.reshape(-1, 36)[:, ::7] += diagonal_floor(torch.float64)
        slots = np.arange(num_free)
        reduced.reshape(-1, 6, num_free, 6)[slots, :, slots] += damped
        if gauge is not None:
            reduced += float(reduced.diagonal().mean()) * (gauge @ gauge.T)
        right = self.frames_gradient.reshape(-1) - coupling @ halves.reshape(-1)
        frames = solve_symmetric(reduced, right)
        if frames is None:
            return None
        points = np.stack(upper_times(root, halves - (frames @ coupling).reshape(3, -1)))
        slope = frames @ self.frames_gradient.reshape(-1) + (points * self.points_gradient).sum()
        return _Step(frames.reshape(-1, 6), points, 0.5 * float(slope))

    def _coupling(self, root: Array) -> Array:
        """Blocks (6 K', 3 N) of frames against points, times the inverse roots of the points' blocks."""
        q, blocks = root.take(self.bundle.point[: self.bundle.linked], axis=1), self.blocks
        whitened = np.empty(blocks.shape)
        for row, entry in enumerate(lower_times(q, blocks.transpose(1, 0, 2))):
            whitened[:, row] = entry
        shape = 6 * len(self.frames), 3 * root.shape[1]
        coupling: Array = np.bincount(self.bundle.cells, whitened.reshape(-1), shape[0] * shape[1])
        return coupling.reshape(shape)
