"""The discrete part of a pose graph: what counts, what moves, and in which order sums and eliminations go."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.optim.pose_graph.sparse_cholesky import BlockStructure, build_block_structure


@dataclass(frozen=True)
class Groups:
    """Rows that are summed by group, in a fixed order."""

    order: Tensor
    counts: Tensor

    @staticmethod
    def of(index: Tensor, count: int) -> Groups:
        return Groups(torch.argsort(index, stable=True), torch.bincount(index, minlength=count))

    def sum(self, values: Tensor) -> Tensor:
        """(B, N, ...) -> (B, groups, ...)."""
        shape = (len(self.counts), values.shape[0], *values.shape[2:])
        flat = values.transpose(0, 1).index_select(0, self.order).flatten(1)
        total = torch.segment_reduce(flat, "sum", lengths=self.counts, unsafe=True)
        return total.view(shape).transpose(0, 1)


@dataclass(frozen=True)
class Layout:
    """The discrete part of a pose graph: what counts, what moves, and in which order it is processed.

    i, j:     (E,) int64 nodes of the edges
    counted:  (B, E) bool; moving: (B, K) bool, nodes that counted edges join with a fixed one
    linking:  (L,) edges that, in some element, join two moving nodes; turned: (L,) bool, whether the block of the pair
              of nodes is the transpose of the edge's; by_pair: the edges of each pair; by_node: the edges' ends, first
              all i, then all j, of each node
    """

    i: Tensor
    j: Tensor
    counted: Tensor
    moving: Tensor
    linking: Tensor
    turned: Tensor
    by_pair: Groups
    by_node: Groups
    structure: BlockStructure


def build_layout(edges: Tensor, counted: Tensor, fixed: Tensor, dims: int) -> Layout:
    """Decide what moves, and the order of elimination. edges: (E, 2); counted: (B, E); fixed: (B, K)."""
    i, j = edges.unbind(-1)
    num_nodes = fixed.shape[1]
    moving = _reached(edges, counted, fixed) & ~fixed
    linking = (counted & moving[:, i] & moving[:, j]).any(0).nonzero().squeeze(-1)
    low, high = edges[linking].amin(-1), edges[linking].amax(-1)
    keys, positions = torch.unique(low * num_nodes + high, return_inverse=True)
    pairs = torch.stack((keys // num_nodes, keys % num_nodes), dim=-1)
    return Layout(
        i,
        j,
        counted,
        moving,
        linking,
        j[linking] == high,
        Groups.of(positions, len(pairs)),
        Groups.of(torch.cat((i, j)), num_nodes),
        build_block_structure(num_nodes, dims, pairs),
    )


def _reached(edges: Tensor, counted: Tensor, fixed: Tensor) -> Tensor:
    """Which nodes (B, K) counted edges join, over others or not, with a fixed one.

    Every node points to one of its component with a number not above its own; edges hook these onto one another, and
    pointers are shortened, until nothing changes: about log K rounds.
    """
    num_nodes = fixed.shape[1]
    label = torch.arange(num_nodes, device=fixed.device).expand_as(fixed)
    ends = edges.T.flatten()
    while True:
        at_ends = label[:, ends]
        low = torch.minimum(*at_ends.chunk(2, dim=1))
        low = torch.where(counted, low, num_nodes).repeat(1, 2)
        hooked = label.scatter_reduce(1, at_ends, low, "amin")
        hooked = hooked.scatter_reduce(1, ends.expand_as(low), low, "amin")
        shortened = hooked.gather(1, hooked)
        if torch.equal(shortened, label):
            break
        label = shortened
    has_fixed = torch.zeros_like(label).scatter_reduce(1, label, fixed.long(), "amax")
    return has_fixed.gather(1, label) > 0
