"""Normal equations of a window of frames and the points that they see, and the damped steps they lead to: on the host.

Frames move along the axes of the world, as in `assembly`. The points are eliminated (`schur`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchslam.optim.core.numpy_backend import Array

# Keeps a frame solvable that lost all it saw: its step is zero.
_TINY = float(np.finfo(np.float64).tiny) ** 0.5

LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
"""Of a symmetric 3x3 matrix the entries that are kept."""


class Step(NamedTuple):
    """frames: (F', 6) of the free ones, along the axes of the world; points: (3, P); promised: by how much the cost
    is to fall"""

    frames: Array
    points: Array
    promised: float


@dataclass(frozen=True)
class Equations:
    """frames: (F', 6, 6), frames_gradient: (F', 6); points: (6, P) as of `LOWER`, points_gradient: (3, P);
    blocks: (6, 3, O') of observations by free frames, frame against point; point: (O',) of each; cells: (18 O',) where
    their entries stand in the coupling (6 F', 3 P)
    """

    frames: Array
    frames_gradient: Array
    points: Array
    points_gradient: Array
    blocks: Array
    point: Array
    cells: Array

    def step(self, damping: float, gauge: Array | None) -> Step | None:
        """What minimises the damped model; None where there is no minimum.

        gauge: (6 F', g) directions of the frames along which the step is to be zero
        """
        root = _inverse_root(self.points, damping)
        halves = _lower_times(root, self.points_gradient)
        num_free = len(self.frames)
        if not num_free:
            points = _upper_times(root, halves)
            return Step(np.zeros((0, 6)), points, 0.5 * float((points * self.points_gradient).sum()))
        coupling = self._coupling(root)
        reduced = -(coupling @ coupling.T)
        damped = self.frames.copy()
        damped.reshape(-1, 36)[:, ::7] *= 1 + damping
        damped.reshape(-1, 36)[:, ::7] += _TINY
        slots = np.arange(num_free)
        reduced.reshape(-1, 6, num_free, 6)[slots, :, slots] += damped
        if gauge is not None:
            reduced += float(reduced.diagonal().mean()) * (gauge @ gauge.T)
        right = self.frames_gradient.reshape(-1) - coupling @ halves.reshape(-1)
        frames = _solved(reduced, right)
        if frames is None:
            return None
        points = _upper_times(root, halves - (frames @ coupling).reshape(3, -1))
        promised = 0.5 * float(
            frames @ self.frames_gradient.reshape(-1) + (points * self.points_gradient).sum()
        )
        return Step(frames.reshape(-1, 6), points, promised)

    def _coupling(self, root: Array) -> Array:
        """(6 F', 3 P) the frames' blocks against the points, times the inverse roots of these."""
        q, blocks = root.take(self.point, axis=1), self.blocks
        whitened = np.empty(blocks.shape)
        whitened[:, 0] = q[0] * blocks[:, 0]
        whitened[:, 1] = q[1] * blocks[:, 0] + q[2] * blocks[:, 1]
        whitened[:, 2] = q[3] * blocks[:, 0] + q[4] * blocks[:, 1] + q[5] * blocks[:, 2]
        shape = 6 * len(self.frames), 3 * root.shape[1]
        coupling: Array = np.bincount(self.cells, whitened.reshape(-1), shape[0] * shape[1]).reshape(shape)
        return coupling


def _solved(matrix: Array, right: Array) -> Array | None:
    """matrix^-1 right; None where the matrix is not positive definite."""
    diagonal = matrix.diagonal()
    if not (diagonal > 0).all():
        return None
    scale = diagonal**-0.5
    scaled = scale[:, None] * matrix * scale
    try:
        np.linalg.cholesky(scaled)  # says whether it is definite
        solution: Array = scale * np.linalg.solve(scaled, scale * right)
    except np.linalg.LinAlgError:
        return None
    return solution


def _inverse_root(blocks: Array, damping: float) -> Array:
    """Lower triangular Q with Q^T Q = block^-1, zero where a block is not definite: (6, P) as of `LOWER` -> same.

    Cholesky's factors, written out, of blocks that were scaled to a unit diagonal: as `grid_equations`.
    """
    growth = 1 + damping
    b00, b10, b11, b20, b21, b22 = blocks
    diagonal = growth * np.stack((b00, b11, b22))
    is_definite = (diagonal > 0).all(0)
    s0, s1, s2 = 1 / np.sqrt(np.where(is_definite, diagonal, 1.0))
    l10, l20 = b10 * s1 * s0, b20 * s2 * s0
    pivot = 1 - l10 * l10
    is_definite &= pivot > 0
    i1 = 1 / np.sqrt(np.where(is_definite, pivot, 1.0))
    l21 = (b21 * s2 * s1 - l20 * l10) * i1
    pivot = 1 - l20 * l20 - l21 * l21
    is_definite &= pivot > 0
    i2 = 1 / np.sqrt(np.where(is_definite, pivot, 1.0))
    q10, q20 = -l10 * s0 * i1, -(l20 - l21 * l10 * i1) * s0 * i2
    root: Array = np.stack((s0, q10, s1 * i1, q20, -l21 * s1 * i1 * i2, s2 * i2)) * is_definite
    return root


def _lower_times(q: Array, v: Array) -> Array:
    """Q v of lower triangles (6, P) and vectors (3, P)."""
    return np.stack((q[0] * v[0], q[1] * v[0] + q[2] * v[1], q[3] * v[0] + q[4] * v[1] + q[5] * v[2]))


def _upper_times(q: Array, v: Array) -> Array:
    """Q^T v of lower triangles (6, P) and vectors (3, P)."""
    return np.stack((q[0] * v[0] + q[1] * v[1] + q[3] * v[2], q[2] * v[1] + q[4] * v[2], q[5] * v[2]))
