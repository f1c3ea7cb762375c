"""Pose graphs whose loops are partly false: what a method sees of them, the truth, and their solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchslam.geometry import sim3_inverse, sim3_log, umeyama
from torchslam.optim import PoseGraph, pose_graph_optimize
from torchslam.optim.core.implicit import Backward


@dataclass(frozen=True)
class Graphs:
    """G graphs of K nodes along a way and up to N loops each.

    S_cw_true: (G, K, 4, 4) the truth, world to node
    odometry:  (G, K - 1, 4, 4) measured, from every node to the next; odometry_sigmas: (G, K - 1, 7) what is believed
               of its noise: translation, rotation, log scale
    pairs:     (G, N, 2) int64 nodes (i, j), i before j, of loops; loops: (G, N, 4, 4) measured, from i to j;
               loop_sigmas: (G, N, 7)
    genuine:   (G, N) bool, the truth; mask: (G, N) bool, whether there is a loop
    """

    S_cw_true: Tensor
    odometry: Tensor
    odometry_sigmas: Tensor
    pairs: Tensor
    loops: Tensor
    loop_sigmas: Tensor
    genuine: Tensor
    mask: Tensor

    def __len__(self) -> int:
        return len(self.S_cw_true)

    def __getitem__(self, rows: slice | Tensor | Sequence[int]) -> Graphs:
        return Graphs(*(getattr(self, field.name)[rows] for field in fields(self)))

    @staticmethod
    def cat(parts: Sequence[Graphs]) -> Graphs:
        """All graphs of all parts; those with fewer loops get empty rows."""
        most = max(part.mask.shape[1] for part in parts)
        padded = [part.padded(most) for part in parts]
        return Graphs(
            *(torch.cat([getattr(part, field.name) for part in padded]) for field in fields(Graphs))
        )

    def padded(self, loops: int) -> Graphs:
        """The same graphs with rows for more loops, which are none."""
        missing = loops - self.mask.shape[1]
        if missing == 0:
            return self
        graphs = len(self)
        eye = torch.eye(4, dtype=self.loops.dtype).expand(graphs, missing, 4, 4)
        none = torch.zeros(graphs, missing, dtype=torch.bool)
        return Graphs(
            self.S_cw_true,
            self.odometry,
            self.odometry_sigmas,
            torch.cat([self.pairs, torch.tensor([0, 1]).expand(graphs, missing, 2)], 1),
            torch.cat([self.loops, eye], 1),
            torch.cat([self.loop_sigmas, self.loop_sigmas.new_ones(graphs, missing, 7)], 1),
            torch.cat([self.genuine, none], 1),
            torch.cat([self.mask, none], 1),
        )


def dead_reckoning(graphs: Graphs) -> Tensor:
    """(G, K, 4, 4) the nodes by odometry alone, from the true first one."""
    nodes = [graphs.S_cw_true[:, 0]]
    for step in graphs.odometry.unbind(1):
        nodes.append(step @ nodes[-1])
    return torch.stack(nodes, 1)


def chi_squares(graphs: Graphs, S_cw: Tensor) -> Tensor:
    """(G, N) squared whitened errors of the loops at nodes (G, K, 4, 4)."""
    rows = torch.arange(len(graphs))[:, None]
    S_i, S_j = S_cw[rows, graphs.pairs[..., 0]], S_cw[rows, graphs.pairs[..., 1]]
    errors = sim3_log(S_j @ sim3_inverse(S_i) @ sim3_inverse(graphs.loops))
    return (errors / graphs.loop_sigmas).square().sum(-1)


def solve(
    graphs: Graphs,
    weights: Tensor,
    start: Tensor | None = None,
    iterations: int = 30,
    backward: Backward = "detached",
) -> Tensor:
    """(G, K, 4, 4) the least-squares solutions with weights (G, N) of the loops; the first nodes stay.

    One sparse problem for all: graphs side by side, joined by nothing.
    """
    count, nodes = graphs.S_cw_true.shape[:2]
    start = dead_reckoning(graphs) if start is None else start
    chain = torch.arange(nodes - 1)
    offset = nodes * torch.arange(count)[:, None, None]
    steps = torch.stack([chain, chain + 1], -1) + offset
    used = graphs.mask.flatten()
    loops = (graphs.pairs + offset).flatten(0, 1)[used]
    odometry_information = torch.diag_embed(graphs.odometry_sigmas.flatten(0, 1) ** -2)
    loop_information = torch.diag_embed(graphs.loop_sigmas.flatten(0, 1)[used] ** -2)
    trust = weights.flatten()[used].to(loop_information.dtype)
    graph = PoseGraph(
        start.flatten(0, 1),
        torch.cat([steps.flatten(0, 1), loops]),
        torch.cat([graphs.odometry.flatten(0, 1), graphs.loops.flatten(0, 1)[used]]),
        torch.cat([odometry_information, trust[:, None, None] * loop_information]),
        fixed=offset.flatten(),
    )
    return pose_graph_optimize(graph, kernel="none", backward=backward, iterations=iterations).S_cw.view(
        count, nodes, 4, 4
    )


def ate(S_cw: Tensor, S_cw_true: Tensor) -> Tensor:
    """(G,) root mean square distance of the centres after alignment by a similarity, in steps."""
    found, truth = sim3_inverse(S_cw)[..., :3, 3], sim3_inverse(S_cw_true)[..., :3, 3]
    scale, R, t = umeyama(found, truth)
    aligned = scale[..., None, None] * (found @ R.mT) + t[..., None, :]
    return (aligned - truth).square().sum(-1).mean(-1).sqrt()
