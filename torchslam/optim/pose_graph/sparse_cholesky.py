"""Sparse symmetric systems of small blocks on a graph: multifrontal Cholesky, batched, that never raises.

The matrix has a (D, D) block for every node and one for every pair of joined nodes. A batch shares the graph and so the
order of elimination (see `dissection`); every sum has a fixed order: the same bytes on every run.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.optim.pose_graph.nested_dissection import dissect


@dataclass(frozen=True)
class Front:
    """A dense matrix over some nodes: those eliminated, then those joined with them.

    size:    (eliminated, all) scalar rows of the front
    rows:    (size[1],) int64 rows of the whole system
    entries: (m,) int64 blocks of the system that first appear here, at block row and column `places` (2, m)
    parent:  the front that takes what remains, at its scalar rows `parent_rows`; -1 where nothing remains
    """

    size: tuple[int, int]
    rows: Tensor
    entries: Tensor
    places: Tensor
    parent: int
    parent_rows: Tensor


@dataclass(frozen=True)
class BlockStructure:
    """Which nodes are joined, and the order of elimination; made once per problem.

    pairs: (P, 2) int64, every joined pair once
    """

    num_nodes: int
    dims: int
    pairs: Tensor
    fronts: list[Front]


def build_block_structure(num_nodes: int, dims: int, pairs: Tensor) -> BlockStructure:
    """The structure of a system with (dims, dims) blocks for `num_nodes` nodes and the pairs (P, 2) of them."""
    device, listed = pairs.device, pairs.tolist()
    ordered = dissect(num_nodes, listed)
    local = [
        {node: place for place, node in enumerate(front.eliminated + front.boundary)} for front in ordered
    ]
    front_of = {node: index for index, front in enumerate(ordered) for node in front.eliminated}
    parents = {child: index for index, front in enumerate(ordered) for child in front.children}
    appear: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
    for node, index in front_of.items():
        appear[index].append((node, local[index][node], local[index][node]))
    for number, (a, b) in enumerate(listed):
        index = min(front_of[a], front_of[b])
        row, column = local[index][a], local[index][b]
        appear[index] += [
            (num_nodes + number, row, column),
            (num_nodes + len(listed) + number, column, row),
        ]

    def scalars(places: list[int]) -> Tensor:
        blocks = torch.tensor(places, dtype=torch.int64, device=device)
        return (blocks[:, None] * dims + torch.arange(dims, device=device)).flatten()

    fronts = []
    for index, front in enumerate(ordered):
        entries = torch.tensor(appear[index], dtype=torch.int64, device=device).view(-1, 3)
        parent = parents[index] if front.boundary else -1
        places = [local[parent][node] for node in front.boundary] if front.boundary else []
        size = dims * len(front.eliminated), dims * len(local[index])
        fronts.append(
            Front(size, scalars(list(local[index])), entries[:, 0], entries[:, 1:].T, parent, scalars(places))
        )
    return BlockStructure(num_nodes, dims, pairs, fronts)


@dataclass(frozen=True)
class SparseFactor:
    """Cholesky factors of systems that were scaled to a unit diagonal.

    scale:    (B, K * D) such that scale * matrix * scale has a unit diagonal
    factors:  per front the lower triangle (B, n, n) of what is eliminated, and the rows below it (B, m, n)
    definite: (B,) bool, the matrix is positive definite, whatever its units
    """

    structure: BlockStructure
    scale: Tensor
    factors: list[tuple[Tensor, Tensor]]
    definite: Tensor

    def solve(self, right: Tensor) -> Tensor:
        """matrix^-1 right, zero where the matrix is not definite. (B, K, D) -> (B, K, D)."""
        x = (self.scale * right.flatten(1))[..., None]
        halves = []
        for front, (lower, below) in zip(self.structure.fronts, self.factors, strict=True):
            own, boundary = front.rows.tensor_split((front.size[0],))
            half = torch.linalg.solve_triangular(lower, x.index_select(1, own), upper=False)
            halves.append(half)
            if front.parent >= 0:
                x = x.index_add(1, boundary, below @ half, alpha=-1)
        for front, (lower, below), half in zip(
            reversed(self.structure.fronts), reversed(self.factors), reversed(halves), strict=True
        ):
            own, boundary = front.rows.tensor_split((front.size[0],))
            half = half - below.mT @ x.index_select(1, boundary)
            x = x.index_copy(1, own, torch.linalg.solve_triangular(lower.mT, half, upper=True))
        solution = self.scale * x.squeeze(-1)
        return torch.where(self.definite[:, None], solution, 0.0).view_as(right)


def factorize_sparse(
    structure: BlockStructure,
    diagonal: Tensor,
    across: Tensor,
    damping: Tensor | None = None,
    strict: bool = True,
) -> SparseFactor:
    """Cholesky factorisation of symmetric block systems that never raises.

    diagonal: (B, K, D, D) blocks of the nodes; across: (B, P, D, D) blocks at (pairs[p, 0], pairs[p, 1])
    damping:  (B,) share by which the diagonal grows
    strict:   count a matrix as definite only if it is clearly so, beyond rounding
    """
    d = diagonal.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(d > 0, d, 1.0).rsqrt()
    first, second = (scale.index_select(1, nodes) for nodes in structure.pairs.unbind(-1))
    scaled = scale[..., :, None] * diagonal * scale[..., None, :]
    if damping is not None:
        eye = torch.eye(structure.dims, dtype=d.dtype, device=d.device)
        scaled = scaled + damping[:, None, None, None] * eye
    across = first[..., :, None] * across * second[..., None, :]
    blocks = torch.cat((scaled, across, across.mT), dim=1)

    definite = torch.ones(len(d), dtype=torch.bool, device=d.device)
    remaining: dict[int, list[tuple[Tensor, Tensor]]] = defaultdict(list)
    factors = []
    for index, front in enumerate(structure.fronts):
        matrix = _assemble(structure.dims, front, blocks, remaining.pop(index, []))
        n = front.size[0]
        lower, info = torch.linalg.cholesky_ex(matrix[:, :n, :n])
        if info.any():  # unit matrices instead: what follows stays finite, its gradient included
            definite = definite & (info == 0)
            unit = torch.eye(n, dtype=d.dtype, device=d.device)
            lower, _ = torch.linalg.cholesky_ex(torch.where(definite[:, None, None], matrix[:, :n, :n], unit))
        # Rows below times the inverse transpose of the triangle.
        below = torch.linalg.solve_triangular(lower.mT, matrix[:, n:, :n], upper=True, left=False)
        if front.parent >= 0:
            rest = torch.baddbmm(matrix[:, n:, n:], below, below.mT, alpha=-1)
            remaining[front.parent].append((front.parent_rows, rest))
        factors.append((lower, below))
    if strict:
        pivots = torch.cat([lower.diagonal(dim1=-2, dim2=-1) for lower, _ in factors], dim=-1)
        definite = definite & (pivots > torch.finfo(d.dtype).eps ** 0.4).all(-1)
    return SparseFactor(structure, scale.flatten(1), factors, definite)


def _assemble(dims: int, front: Front, blocks: Tensor, parts: list[tuple[Tensor, Tensor]]) -> Tensor:
    """The matrix of a front: blocks that first appear in it, and what remains of the fronts before."""
    size, count = front.size[1], front.size[1] // dims
    matrix = blocks.new_zeros(len(blocks), count, count, dims, dims)
    matrix[:, front.places[0], front.places[1]] = blocks.index_select(1, front.entries)
    matrix = matrix.transpose(2, 3).reshape(-1, size, size)
    for rows, rest in parts:
        matrix[:, rows[:, None], rows] += rest
    return matrix
