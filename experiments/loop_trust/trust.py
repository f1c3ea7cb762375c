"""Networks that say how much a loop should count, from how all loops of a graph agree."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from experiments.loop_trust.baselines import agreement
from experiments.loop_trust.graphs import Graphs, chi_squares, solve
from torchslam.optim.core.implicit import Backward

WIDTH = 32
_LAYERS = 3
_SAME = 5.0  # nodes over which two loops at the same place lie
_QUANTILES = (0.1, 0.25, 0.5, 0.75)
_LARGEST = 30.0  # of what is told of a loop: logarithms, beyond which a loop is not more false


@dataclass(frozen=True)
class Cues:
    """What the networks see. alone: (G, N, A) of a loop; paired: (G, N, N, P) of two; mask: (G, N)."""

    alone: Tensor
    paired: Tensor
    mask: Tensor

    def __getitem__(self, rows: Tensor) -> Cues:
        return Cues(self.alone[rows], self.paired[rows], self.mask[rows])


@torch.no_grad()
def describe(graphs: Graphs) -> Cues:
    """Cues of graphs, float32; nothing in them has a unit."""
    agree = agreement(graphs)
    i, j = graphs.pairs.to(agree.own.dtype).unbind(-1)
    both = graphs.mask[:, :, None] & graphs.mask[:, None]
    other = both & ~torch.eye(graphs.mask.shape[1], dtype=torch.bool)
    shift = (i[:, :, None] - i[:, None]).abs() + (j[:, :, None] - j[:, None]).abs()
    first, last = torch.maximum(i[:, :, None], i[:, None]), torch.minimum(j[:, :, None], j[:, None])
    union = torch.maximum(j[:, :, None], j[:, None]) - torch.minimum(i[:, :, None], i[:, None])
    pairwise = agree.pairwise.log1p()
    paired = torch.stack(
        [
            pairwise,
            agree.surprise.clamp_min(0).log1p(),
            agree.way.clamp_min(0).log1p(),
            (last - first).clamp_min(0) / union,
            (-shift / _SAME).exp(),
            pairwise - 2 * agree.way.clamp_min(0).log1p(),
        ],
        -1,
    )
    own = torch.cat([agree.own[..., None], agree.in_parts], -1).log1p()
    rows = _quantiles(pairwise, other)
    whole = torch.cat(
        [_quantiles(pairwise.flatten(1), other.flatten(1)), _quantiles(own[..., 0], graphs.mask)], -1
    )
    near = torch.where(other, (-shift / _SAME).exp(), 0.0).sum(-1)
    alone = torch.cat(
        [
            own,
            (j - i).log()[..., None],
            near.log1p()[..., None],
            rows,
            whole[:, None].expand(*graphs.mask.shape, -1),
        ],
        -1,
    )
    return Cues(
        torch.where(graphs.mask[..., None], alone.clamp(-_LARGEST, _LARGEST), 0.0).float(),
        torch.where(other[..., None], paired.clamp(-_LARGEST, _LARGEST), 0.0).float(),
        graphs.mask,
    )


def _quantiles(values: Tensor, mask: Tensor) -> Tensor:
    """(..., 4) of the last dimension; zero where there is nothing."""
    found = torch.where(mask, values, torch.nan).nanquantile(values.new_tensor(_QUANTILES), dim=-1)
    return found.movedim(0, -1).nan_to_num()


class Rounds(nn.Module):
    """One network: messages between all loops of a graph, three times. alone, paired: numbers of cues."""

    def __init__(self, alone: int, paired: int) -> None:
        super().__init__()
        self.scale_alone = nn.BatchNorm1d(alone, momentum=None, affine=False)
        self.scale_paired = nn.BatchNorm1d(paired, momentum=None, affine=False)
        self.enter = nn.Sequential(nn.Linear(alone, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH))
        self.here = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(_LAYERS))
        self.there = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(_LAYERS))
        self.between = nn.ModuleList(nn.Linear(paired, WIDTH) for _ in range(_LAYERS))
        self.gate = nn.ModuleList(nn.Linear(WIDTH, 1) for _ in range(_LAYERS))
        self.update = nn.ModuleList(
            nn.Sequential(nn.Linear(4 * WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH))
            for _ in range(_LAYERS)
        )
        self.leave = nn.Linear(WIDTH, 1)

    def measure(self, alone: Tensor, paired: Tensor, mask: Tensor) -> None:
        """Learn what is usual from cues of a training set."""
        other = mask[:, :, None] & mask[:, None]
        self.scale_alone.train()(alone[mask])
        self.scale_paired.train()(paired[other])
        self.eval()

    def forward(self, alone: Tensor, paired: Tensor, mask: Tensor) -> Tensor:
        """(G, N) logits."""
        h = self.enter(self.scale_alone(alone.flatten(0, -2)).view_as(alone))
        pair = self.scale_paired(paired.flatten(0, -2)).view_as(paired)
        other = (mask[:, :, None] & mask[:, None])[..., None].to(h.dtype)
        used = mask[..., None].to(h.dtype)
        count = used.sum(1, keepdim=True).clamp_min(1)
        for here, there, between, gate, update in zip(
            self.here, self.there, self.between, self.gate, self.update, strict=True
        ):
            message = torch.relu(here(h)[:, :, None] + there(h)[:, None] + between(pair)) * other
            share = torch.sigmoid(gate(message)) * other
            heard = (share * message).sum(2)
            told, agreed = heard / count, heard / (share.sum(2) + 0.1)
            whole = ((used * h).sum(1, keepdim=True) / count).expand_as(h)
            h = h + update(torch.cat([h, told, agreed, whole], -1))
        return self.leave(h).squeeze(-1)


class LoopTrust(nn.Module):
    """Weights of loops in two rounds: the second one, a network of its own, sees what the solution of the first one
    leaves of every loop, and corrects.
    """

    def __init__(self, alone: int, paired: int, seed: int = 0) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.first = Rounds(alone, paired)
            self.second = Rounds(alone + 3, paired)
        nn.init.zeros_(self.second.leave.weight)
        nn.init.zeros_(self.second.leave.bias)

    def logits(self, cues: Cues) -> Tensor:
        """(G, N) of the first round."""
        return self.first(cues.alone, cues.paired, cues.mask)

    def corrected(self, cues: Cues, logits: Tensor, squared: Tensor) -> Tensor:
        """(G, N) of the second round; squared: (G, N) what the first one's solution leaves."""
        return logits + self.second(seen(cues, logits, squared), cues.paired, cues.mask)


def weight(logits: Tensor) -> Tensor:
    """The weight of a loop in the solver: the probability squared.

    A false loop is some hundred standard deviations off: a weight of one in a thousand still bends the graph.
    """
    return torch.sigmoid(logits).square()


def seen(cues: Cues, logits: Tensor, squared: Tensor) -> Tensor:
    """(G, N, A + 3) cues with the weight of the first round, and its residual, also beside that of others trusted."""
    left = squared.log1p().clamp_max(_LARGEST).float()
    trust = torch.sigmoid(logits) * cues.mask
    usual = (trust * left).sum(-1, keepdim=True) / trust.sum(-1, keepdim=True).clamp_min(1e-3)
    more = torch.stack([logits / 4, left, left - usual], -1).detach()
    return torch.cat([cues.alone, torch.where(cues.mask[..., None], more, 0.0)], -1)


def trusted(
    network: LoopTrust, graphs: Graphs, cues: Cues, backward: Backward = "detached"
) -> list[tuple[Tensor, Tensor]]:
    """Weights (G, N) and nodes (G, K, 4, 4) of both rounds."""
    logits = network.logits(cues)
    weights = weight(logits)
    S_cw = solve(graphs, weights, backward=backward)
    squared = chi_squares(graphs, S_cw.detach())
    weights_2 = weight(network.corrected(cues, logits, squared))
    return [(weights, S_cw), (weights_2, solve(graphs, weights_2, S_cw.detach(), backward=backward))]


@dataclass(frozen=True)
class Learned:
    """A network as a method; rounds: how many of the two."""

    network: LoopTrust
    rounds: int = 2

    def __call__(self, graphs: Graphs) -> Tensor:
        cues = describe(graphs)
        if self.rounds == 1:
            return solve(graphs, weight(self.network.logits(cues)))
        return trusted(self.network, graphs, cues)[-1][1]
