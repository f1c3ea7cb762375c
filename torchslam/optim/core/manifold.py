"""What unknowns move on: how a step in the tangent space changes them, to first order and at any length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torchslam.optim.core import tangent
from torchslam.optim.core.batching import Tensors

Manifold = Literal["euclidean", "se3", "sim3"]
"""What an unknown moves on.

"euclidean": any tensor (B, ...), as a vector
"se3":       rigid transforms (B, ..., 4, 4), by left perturbations (translation, rotation)
"sim3":      similarities (B, ..., 4, 4), by left perturbations (translation, rotation, log scale)
"""


class _Moves(NamedTuple):
    """For steps (..., D) of matrices (..., 4, 4): as the functions of `tangent`."""

    dims: int
    retract: Callable[[Tensor, Tensor], Tensor]
    push: Callable[[Tensor, Tensor], Tensor]
    pull_back: Callable[[Tensor, Tensor], Tensor]


_MATRICES = {
    "se3": _Moves(6, tangent.retract, tangent.push, tangent.pull_back),
    "sim3": _Moves(7, tangent.retract_sim3, tangent.push_sim3, tangent.pull_back_sim3),
}


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
            (*shape[:-2], _MATRICES[name].dims) if name in _MATRICES else shape
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

    def basis(self, unknowns: Tensors) -> Tensor:
        """(n, B, n) unit steps, each for the whole batch."""
        size = sum(prod(shape) for shape in self.step_shapes)
        eye = torch.eye(size, dtype=unknowns[0].dtype, device=unknowns[0].device)
        return eye[:, None].expand(size, len(unknowns[0]), size)

    def retract(self, unknowns: Tensors, step: Tensor) -> Tensors:
        """The unknowns moved along a step (B, n)."""
        return tuple(
            _MATRICES[name].retract(x, part) if name in _MATRICES else x + part
            for name, x, part in zip(self.manifolds, unknowns, self._parts(step), strict=True)
        )

    def push(self, unknowns: Tensors, step: Tensor) -> Tensors:
        """The change of the unknowns, to first order, along a step (B, n)."""
        return tuple(
            _MATRICES[name].push(x, part) if name in _MATRICES else part
            for name, x, part in zip(self.manifolds, unknowns, self._parts(step), strict=True)
        )

    def pull_back(self, unknowns: Tensors, gradient: Tensors) -> Tensor:
        """(B, n) the gradient in the step of a loss with this gradient in the unknowns."""
        parts = [
            _MATRICES[name].pull_back(x, part) if name in _MATRICES else part
            for name, x, part in zip(self.manifolds, unknowns, gradient, strict=True)
        ]
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    def _parts(self, step: Tensor) -> list[Tensor]:
        shapes = self.step_shapes
        parts = step.split([prod(shape) for shape in shapes], dim=-1)
        return [part.reshape(len(step), *shape) for part, shape in zip(parts, shapes, strict=True)]
