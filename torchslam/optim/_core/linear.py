"""Symmetric systems that may be singular: solved where they are definite, flagged where not; dense or sparse.

A sparse one has small blocks on a graph, and is factorized by batched multifrontal Cholesky: a (D, D) block for every
node and one for every pair of joined nodes. A batch shares the graph and so the order of elimination, which is that of
nested dissection: a small set of nodes, the separator, splits a graph in two parts that are not joined. Eliminated
after both of them, it keeps them from filling in between each other; each part is split again. The nodes eliminated
together, and those that they are joined with by then, are a front: a dense matrix, so that the work is few large
products. Every sum has a fixed order: the same bytes on every run.
Sources: George, "Nested dissection of a regular finite element mesh", 1973; Duff and Reid, "The multifrontal solution
of indefinite sparse symmetric linear equations", 1983.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

LOWER_3X3 = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
"""The entries of a symmetric 3x3 block that are stored, in the order of `inverse_root_3x3`."""


def diagonal_floor(dtype: torch.dtype) -> float:
    """What a diagonal entry grows by to stay solvable without observations; its step is then zero."""
    return torch.finfo(dtype).tiny ** 0.5


def smallest_pivot(dtype: torch.dtype) -> float:
    """The pivot, of a matrix scaled to a unit diagonal, above which it is positive beyond rounding."""
    return torch.finfo(dtype).eps ** 0.4


@dataclass(frozen=True)
class DefiniteFactor:
    """Cholesky factors of symmetric matrices that were scaled to a unit diagonal.

    Attributes:
        scale: such that scale * matrix * scale has a unit diagonal
        factor: lower triangular
        definite: the matrix is positive definite, whatever its units
    """

    scale: Float[Tensor, "*batch D"]
    factor: Float[Tensor, "*batch D D"]
    definite: Bool[Tensor, "*batch"]

    def solve(self, right: Float[Tensor, "*#batch D n"]) -> Float[Tensor, "*#batch D n"]:
        """matrix^-1 right, zero where the matrix is not definite."""
        scale = self.scale[..., None]
        solution = scale * torch.cholesky_solve(scale * right, self.factor)
        return torch.where(self.definite[..., None, None], solution, 0.0)


def factorize(matrix: Float[Tensor, "*batch D D"], strict: bool = True) -> DefiniteFactor:
    """Cholesky factorization that never raises; strict: a matrix is definite only if it is clearly so, beyond
    rounding."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    scaled = scale[..., :, None] * matrix * scale[..., None, :]
    factor, info = torch.linalg.cholesky_ex(scaled)
    definite = info == 0
    if strict:
        pivots = factor.diagonal(dim1=-2, dim2=-1)
        definite = definite & (pivots > smallest_pivot(matrix.dtype)).all(-1)
    if not definite.all():  # unit matrices instead: what follows stays finite, its gradient included
        unit = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        factor, _ = torch.linalg.cholesky_ex(torch.where(definite[..., None, None], scaled, unit))
    return DefiniteFactor(scale, factor, definite)


def inverse_root_3x3(lower: Iterable[Any], mask: Any = True, smallest: float = 0.0) -> list[Any]:
    """Lower triangular Q with Q^T Q = block^-1 of many symmetric 3x3 blocks, by a written-out Cholesky factorization.

    lower: the entries `LOWER_3X3`, tensors or NumPy arrays of one shape; smallest: what the pivots of a block scaled to
    a unit diagonal exceed where it counts as definite. The entries of Q are zero elsewhere, and outside of the mask.
    """
    b00, b10, b11, b20, b21, b22 = lower
    xp: Any = np if isinstance(b00, np.ndarray) else torch

    def inverse_sqrt(pivot: Any, is_definite: Any) -> Any:
        return 1 / xp.sqrt(xp.where(is_definite, pivot, 1.0))

    diagonal = xp.stack((b00, b11, b22))
    is_definite = (diagonal > 0).all(0) & mask
    s0, s1, s2 = inverse_sqrt(diagonal, is_definite)
    l10, l20 = b10 * s1 * s0, b20 * s2 * s0
    pivot = 1 - l10 * l10
    is_definite = is_definite & (pivot > smallest)
    i1 = inverse_sqrt(pivot, is_definite)
    l21 = (b21 * s2 * s1 - l20 * l10) * i1
    pivot = 1 - l20 * l20 - l21 * l21
    is_definite = is_definite & (pivot > smallest)
    i2 = inverse_sqrt(pivot, is_definite)
    q10, q20 = -l10 * s0 * i1, -(l20 - l21 * l10 * i1) * s0 * i2
    root = s0, q10, s1 * i1, q20, -l21 * s1 * i1 * i2, s2 * i2
    return [xp.where(is_definite, entry, 0.0) for entry in root]


def inverse_roots(
    blocks: Float[Tensor, "*batch 3 3 N"],
    mask: Bool[Tensor, "*batch N"],
    damping: Float[Tensor, "*#batch #N"] | None,
) -> Float[Tensor, "*batch 3 3 N"]:
    """`inverse_root_3x3` of blocks whose diagonals grew by the share `damping`; without it, a block is definite only
    if it is clearly so, as in `factorize`."""
    grown = 1.0 if damping is None else 1 + damping
    lower = [blocks[..., i, j, :] * grown if i == j else blocks[..., i, j, :] for i, j in LOWER_3X3]
    smallest = smallest_pivot(blocks.dtype) ** 2 if damping is None else 0.0
    q00, q10, q11, q20, q21, q22 = inverse_root_3x3(lower, mask, smallest)
    zero = torch.zeros_like(q00)
    return torch.stack((q00, zero, zero, q10, q11, zero, q20, q21, q22), dim=-2).unflatten(-2, (3, 3))


def lower_times(q: Any, v: Any) -> list[Any]:
    """Q v of lower triangles with entries `LOWER_3X3`, tensors or arrays, and vectors of three such entries."""
    return [q[0] * v[0], q[1] * v[0] + q[2] * v[1], q[3] * v[0] + q[4] * v[1] + q[5] * v[2]]


def upper_times(q: Any, v: Any) -> list[Any]:
    """Q^T v, as `lower_times`."""
    return [q[0] * v[0] + q[1] * v[1] + q[3] * v[2], q[2] * v[1] + q[4] * v[2], q[5] * v[2]]


# Parts this small are dense fronts: less work than the calls for splitting them further.
_LEAF_NODES = 40


@dataclass(frozen=True)
class Groups:
    """Rows that are summed by group, in a fixed order."""

    order: Int[Tensor, " N"]
    counts: Int[Tensor, " G"]

    @staticmethod
    def of(index: Int[Tensor, " N"], count: int) -> Groups:
        return Groups(torch.argsort(index, stable=True), torch.bincount(index, minlength=count))

    def sum(self, values: Float[Tensor, "B N ..."]) -> Float[Tensor, "B G ..."]:
        """Sums over the rows of each of G groups."""
        shape = (len(self.counts), values.shape[0], *values.shape[2:])
        flat = values.transpose(0, 1).index_select(0, self.order).flatten(1)
        total = torch.segment_reduce(flat, "sum", lengths=self.counts, unsafe=True)
        return total.view(shape).transpose(0, 1)


@dataclass
class FrontNodes:
    """Nodes that are eliminated together, those they are joined with then, and the fronts to be done before."""

    eliminated: list[int]
    children: list[int]
    boundary: list[int] = field(default_factory=list)


def dissect(num_nodes: int, pairs: Iterable[tuple[int, int]]) -> list[FrontNodes]:
    """Fronts that eliminate all nodes, children before their parents. pairs: the joined nodes, each pair once."""
    neighbors: list[list[int]] = [[] for _ in range(num_nodes)]
    for a, b in pairs:
        neighbors[a].append(b)
        neighbors[b].append(a)
    fronts: list[FrontNodes] = []
    _split(list(range(num_nodes)), neighbors, fronts)

    front_of = [0] * num_nodes
    for index, front in enumerate(fronts):
        for node in front.eliminated:
            front_of[node] = index
    for index, front in enumerate(fronts):
        touched = {other for node in front.eliminated for other in neighbors[node]}
        touched.update(*(fronts[child].boundary for child in front.children))
        later = (node for node in touched if front_of[node] > index)
        front.boundary = sorted(later, key=lambda node: (front_of[node], node))
    return fronts


def _split(part: list[int], neighbors: list[list[int]], fronts: list[FrontNodes]) -> list[int]:
    """Append the fronts of a part of the graph; returns those that no other one of the part follows."""
    roots: list[int] = []
    pool: list[int] = []
    inside = set(part)

    def append(nodes: list[int], children: list[int]) -> None:
        roots.append(len(fronts))
        fronts.append(FrontNodes(nodes, children))

    for start in part:
        if start not in inside:
            continue
        levels = _levels(start, neighbors, inside)
        component = [node for level in levels for node in level]
        if len(component) > _LEAF_NODES:
            separator, halves = _separator(_levels(component[-1], neighbors, inside))
            append(separator, [root for half in halves if half for root in _split(half, neighbors, fronts)])
        else:
            pool += component
        inside.difference_update(component)
        if len(pool) > _LEAF_NODES:
            append(pool, [])
            pool = []
    if pool:
        append(pool, [])
    return roots


def _levels(start: int, neighbors: list[list[int]], inside: set[int]) -> list[list[int]]:
    """The nodes reached from `start` inside a part, by their distance from it."""
    levels, seen = [[start]], {start}
    while levels[-1]:
        following = []
        for node in levels[-1]:
            for other in neighbors[node]:
                if other not in seen and other in inside:
                    seen.add(other)
                    following.append(other)
        levels.append(following)
    return levels[:-1]


def _separator(levels: list[list[int]]) -> tuple[list[int], tuple[list[int], list[int]]]:
    """The smallest level that leaves 0.3 of a part on either side, or the middle one, and what lies on either side."""
    total = sum(len(level) for level in levels)
    best, best_size, before = 0, total + 1, 0
    for index, level in enumerate(levels):
        after = total - before - len(level)
        middle = before <= total / 2 and after <= total / 2
        size = len(level) if min(before, after) >= 0.3 * total else total if middle else total + 1
        if size < best_size:
            best, best_size = index, size
        before += len(level)
    below = [node for level in levels[:best] for node in level]
    above = [node for level in levels[best + 1 :] for node in level]
    return levels[best], (below, above)


@dataclass(frozen=True)
class Front:
    """A dense matrix over some nodes: those eliminated, then those joined with them.

    Attributes:
        size: (eliminated, all) scalar rows of the front
        rows: rows of the whole system
        entries: blocks of the system that first appear here, at these block rows and columns `places`
        parent: the front that takes what remains, at its scalar rows `parent_rows`; -1 where nothing remains
    """

    size: tuple[int, int]
    rows: Int[Tensor, " n"]
    entries: Int[Tensor, " m"]
    places: Int[Tensor, "2 m"]
    parent: int
    parent_rows: Tensor


@dataclass(frozen=True)
class BlockStructure:
    """Which pairs of nodes are joined, each once, and the order of elimination; made once per problem."""

    num_nodes: int
    dims: int
    pairs: Int[Tensor, "L 2"]
    fronts: list[Front]


def build_block_structure(num_nodes: int, dims: int, pairs: Int[Tensor, "L 2"]) -> BlockStructure:
    """The structure of a system with (dims, dims) blocks for `num_nodes` nodes and the pairs (P, 2) of them."""
    device, listed, within = pairs.device, pairs.tolist(), torch.arange(dims, device=pairs.device)
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
        appear[index].append((num_nodes + number, row, column))
        appear[index].append((num_nodes + len(listed) + number, column, row))

    def scalars(places: list[int]) -> Tensor:
        return (torch.tensor(places, device=device).long()[:, None] * dims + within).flatten()

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

    Attributes:
        scale: such that scale * matrix * scale has a unit diagonal
        factors: per front the lower triangle (B, n, n) of the eliminated nodes, and the rows below (B, m, n)
        definite: the matrix is positive definite, whatever its units
    """

    structure: BlockStructure
    scale: Float[Tensor, "B KD"]
    factors: list[tuple[Tensor, Tensor]]
    definite: Bool[Tensor, " B"]

    def solve(self, right: Float[Tensor, "B K D"]) -> Float[Tensor, "B K D"]:
        """matrix^-1 right, zero where the matrix is not definite."""
        return self.solve_columns(right.flatten(1)[..., None]).squeeze(-1).view_as(right)

    def solve_columns(self, right: Float[Tensor, "B KD m"]) -> Float[Tensor, "B KD m"]:
        """matrix^-1 right for several right sides at once, zero where the matrix is not definite."""
        x = self.scale[..., None] * right
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
        return torch.where(self.definite[:, None, None], self.scale[..., None] * x, 0.0)

    def inverse_blocks(self) -> tuple[Float[Tensor, "B K D D"], Float[Tensor, "B L D D"]]:
        """The blocks of the inverse at the nodes and at the pairs, zero where the matrix is not definite.

        From the last front to the first: a front's rows of the inverse follow from those of the nodes that it is joined
        with, which its parent knows. The rest of the inverse, which is dense, is not computed.
        Source: Erisman and Tinney, "On computing certain elements of the inverse of a sparse matrix", 1975.
        """
        structure, dims = self.structure, self.structure.dims
        children: dict[int, list[int]] = defaultdict(list)
        for index, front in enumerate(structure.fronts):
            children[front.parent].append(index)
        count = structure.num_nodes + 2 * len(structure.pairs)
        blocks = self.scale.new_zeros(len(self.scale), count, dims, dims)
        given: dict[int, Tensor] = {}  # the inverse among the nodes that a front is joined with
        for index in reversed(range(len(structure.fronts))):
            front, (lower, below) = structure.fronts[index], self.factors[index]
            eye = torch.eye(front.size[0], dtype=lower.dtype, device=lower.device)
            root = torch.linalg.solve_triangular(lower, eye.expand_as(lower), upper=False)
            carried = below @ root
            boundary = given.pop(index, carried.new_zeros(len(carried), 0, 0))
            across = -(boundary @ carried)
            own = root.mT @ root - carried.mT @ across
            whole = torch.cat((torch.cat((own, across.mT), -1), torch.cat((across, boundary), -1)), dim=-2)
            for child in children[index]:
                rows = structure.fronts[child].parent_rows
                given[child] = whole[:, rows[:, None], rows]
            cells = whole.unflatten(1, (-1, dims)).unflatten(3, (-1, dims)).transpose(2, 3)
            blocks[:, front.entries] = cells[:, front.places[0], front.places[1]]
        blocks = torch.where(self.definite[:, None, None, None], blocks, 0.0)
        diagonal, across, _ = blocks.split((structure.num_nodes, *2 * (len(structure.pairs),)), dim=1)
        scale = self.scale.view(len(self.scale), -1, dims)
        first, second = (scale.index_select(1, nodes) for nodes in structure.pairs.unbind(-1))
        return (
            scale[..., :, None] * diagonal * scale[..., None, :],
            first[..., :, None] * across * second[..., None, :],
        )


def factorize_sparse(
    structure: BlockStructure,
    diagonal: Float[Tensor, "B K D D"],
    across: Float[Tensor, "B L D D"],
    damping: Float[Tensor, " B"] | None = None,
    strict: bool = True,
) -> SparseFactor:
    """As `factorize`, of blocks at the nodes and across, at (pairs[p, 0], pairs[p, 1]).

    damping: relative increase of the diagonal
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
        (n, size), dims = front.size, structure.dims
        # Blocks that first appear in the front, and what remains of the fronts before.
        matrix = blocks.new_zeros(len(blocks), size // dims, size // dims, dims, dims)
        matrix[:, front.places[0], front.places[1]] = blocks.index_select(1, front.entries)
        matrix = matrix.transpose(2, 3).reshape(-1, size, size)
        for rows, rest in remaining.pop(index, []):
            matrix[:, rows[:, None], rows] += rest
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
        definite = definite & (pivots > smallest_pivot(d.dtype)).all(-1)
    return SparseFactor(structure, scale.flatten(1), factors, definite)
