"""Graphs with known truth: a walk, its noisy odometry, loops at places met again, and false ones in clusters.

A cluster of loops says that one place is another: every node near the first sees every node near the second where a
similarity D of the world puts it. Genuine is the cluster whose D is the identity; a false one fits itself just as well.
Both are drawn by the same rule, so that neither their size nor their noise tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from experiments.loop_trust.graphs import Graphs
from experiments.loop_trust.walks import Walk
from torchslam.geometry import rigid, sim3_exp, sim3_inverse

_APART = 10  # nodes between the ends of a loop, at least
_NEAR = 1.6  # steps between nodes that see the same
_ELSEWHERE = 3.0  # steps between places that are not the same, at least
_CLUSTER = 8  # loops of a cluster, at most
_LOOPS = (16, 32)  # of a graph, genuine and false
_ALONE = 0.2  # the share of false clusters that are single loops of any size and direction
_MISSES = 60  # draws in a row without a new loop, after which a walk is given up
_BIAS = 0.1  # of odometry, in its standard deviations: scale and heading drift for a reason


@dataclass(frozen=True)
class Noise:
    """Ranges of standard deviations, drawn evenly in the logarithm: translation (steps), rotation (rad), log scale.

    odometry: of one step; loop: of a loop; belief: by what factor, at most, believed deviations are wrong, up or down
    """

    odometry: tuple[tuple[float, float], ...] = ((0.02, 0.15), (0.005, 0.05), (0.005, 0.05))
    loop: tuple[tuple[float, float], ...] = ((0.02, 0.1), (0.005, 0.03), (0.005, 0.03))
    belief: float = 1.0


_BADLY = ((0.05, 0.2), (0.05, 0.1), (0.05, 0.1))
NOISES: dict[str, Noise] = {
    "known noise": Noise(belief=1.5),
    # To an order of magnitude, as systems believe that never measured theirs.
    "unknown noise": Noise(belief=10.0),
    # So much that a false loop may lie within it: a camera without a scale, on a long way.
    "strong drift": Noise(odometry=_BADLY, belief=10.0),
}
TRAINED = Noise(odometry=((0.02, 0.2), (0.005, 0.1), (0.005, 0.1)), belief=10.0)


def simulate(
    walk: Walk,
    nodes: int,
    false_share: tuple[float, float],
    count: int,
    seed: int,
    noise: Noise = TRAINED,
) -> Graphs:
    """`count` graphs; of the loops of each, a share between the two numbers is false, up to whole loops."""
    generator = torch.Generator().manual_seed(seed)
    low, high = false_share
    shares = (low + (high - low) * torch.rand(count, generator=generator)).tolist()
    return Graphs.cat([_one(walk, nodes, share, generator, noise) for share in shares])


def _one(walk: Walk, nodes: int, false_share: float, generator: Generator, noise: Noise) -> Graphs:
    while True:
        T_wc = walk(nodes, generator)
        total = int(torch.randint(_LOOPS[0], _LOOPS[1] + 1, (1,), generator=generator))
        num_false = round(false_share * total)
        genuine = _gathered(T_wc, total - num_false, False, generator)
        false = _gathered(T_wc, num_false, True, generator)
        if genuine is not None and false is not None:
            break
    S_cw = sim3_inverse(T_wc)
    sigmas, loop_sigmas = (_sigmas(ranges, generator) for ranges in (noise.odometry, noise.loop))
    odometry = _perturbed(S_cw[1:] @ T_wc[:-1], sigmas, generator, bias=_BIAS)
    exact = torch.cat([genuine[1], false[1]])
    pairs, loops = _forwards(torch.cat([genuine[0], false[0]]), _perturbed(exact, loop_sigmas, generator))
    is_genuine = torch.arange(total) < total - num_false
    # The order of loops is that of the nodes that asked: it says nothing of their truth.
    order = torch.argsort(pairs[:, 1], stable=True)
    belief = [_factor(noise.belief, generator) for _ in range(2)]
    return Graphs(
        S_cw[None],
        odometry[None],
        (belief[0] * sigmas).expand(1, nodes - 1, 7),
        pairs[order][None],
        loops[order][None],
        (belief[1] * loop_sigmas).expand(1, total, 7),
        is_genuine[order][None],
        torch.ones(1, total, dtype=torch.bool),
    )


def false_loops(
    T_wc: Tensor, count: int, sigmas: Tensor, generator: Generator
) -> tuple[Tensor, Tensor] | None:
    """Nodes (count, 2), i < j, and measurements (count, 4, 4) of false loops on a walk (K, 4, 4) whose unit is a step.

    None where the walk has no room for them.
    """
    found = _gathered(T_wc, count, True, generator)
    if found is None:
        return None
    return _forwards(found[0], _perturbed(found[1], sigmas, generator))


def _forwards(pairs: Tensor, loops: Tensor) -> tuple[Tensor, Tensor]:
    """The same loops from the earlier node to the later one."""
    flipped = (pairs[:, 0] > pairs[:, 1])[:, None, None]
    return pairs.sort(-1).values, torch.where(flipped, sim3_inverse(loops), loops)


def _gathered(T_wc: Tensor, wanted: int, false: bool, generator: Generator) -> tuple[Tensor, Tensor] | None:
    """Nodes (wanted, 2) and exact relative poses (wanted, 4, 4) of loops in clusters; None where a walk has no more."""
    pairs, relative, misses = [torch.empty(0, 2, dtype=torch.int64)], [T_wc.new_empty(0, 4, 4)], 0
    known: set[tuple[int, int]] = set()
    while len(known) < wanted:
        if misses > _MISSES:
            return None
        alone = false and float(torch.rand(1, generator=generator)) < _ALONE
        size = int(torch.randint(1, _CLUSTER + 1, (1,), generator=generator))
        D = _displacement(T_wc, generator) if false else torch.eye(4, dtype=T_wc.dtype)
        if D is None:
            misses += 1
            continue
        found = _single(T_wc, generator) if alone else _cluster(T_wc, D, generator)
        unordered = {(min(pair), max(pair)): pair for pair in found.tolist()}
        fresh = [pair for key, pair in unordered.items() if key not in known]
        fresh = fresh[: min(size, wanted - len(known))]
        misses = misses + 1 if not fresh else 0
        if not fresh:
            continue
        known.update((min(pair), max(pair)) for pair in fresh)
        rows = torch.tensor(fresh)
        pairs.append(rows)
        S_j, T_i = sim3_inverse(T_wc[rows[:, 1]]), T_wc[rows[:, 0]]
        # A single false loop sees anything, as far away as the two nodes might be.
        relative.append(_anything(T_wc, generator)[None] if alone else S_j @ D @ T_i)
    return torch.cat(pairs), torch.cat(relative)


def _displacement(T_wc: Tensor, generator: Generator) -> Tensor | None:
    """The similarity of the world that makes one place look like another one; None where a draw hit one place."""
    centres = T_wc[:, :3, 3]
    a, b = torch.randint(len(T_wc), (2,), generator=generator).tolist()
    if abs(a - b) < _APART or float((centres[a] - centres[b]).norm()) <= _ELSEWHERE:
        return None
    spread = T_wc.new_tensor([0.3] * 3 + [0.1] * 3 + [0.1])
    offset = sim3_exp(spread * torch.randn(7, generator=generator, dtype=T_wc.dtype))
    return T_wc[b] @ offset @ sim3_inverse(T_wc[a])


def _cluster(T_wc: Tensor, D: Tensor, generator: Generator) -> Tensor:
    """(n, 2) nodes i around a place, and j that D puts next to them, in random order."""
    centres = T_wc[:, :3, 3]
    moved = centres @ D[:3, :3].mT + D[:3, 3]
    index = torch.arange(len(centres))
    seen = (torch.cdist(moved, centres) < _NEAR) & ((index[:, None] - index).abs() >= _APART)
    every = seen.nonzero()
    if not len(every):
        return every
    around = every[int(torch.randint(len(every), (1,), generator=generator)), 0]
    here = every[(centres[every[:, 0]] - centres[around]).norm(dim=-1) < 2 * _NEAR]
    return here[torch.randperm(len(here), generator=generator)]


def _single(T_wc: Tensor, generator: Generator) -> Tensor:
    """(0 or 1, 2) two nodes that are not at the same place."""
    pair = torch.randint(len(T_wc), (1, 2), generator=generator)
    apart = (pair[:, 0] - pair[:, 1]).abs() >= _APART
    distant = (T_wc[pair[:, 0], :3, 3] - T_wc[pair[:, 1], :3, 3]).norm(dim=-1) > _ELSEWHERE
    return pair[apart & distant]


def _anything(T_wc: Tensor, generator: Generator) -> Tensor:
    """(4, 4) a relative pose without reason: any rotation, some distance."""
    axis, distance = torch.randn(2, 3, generator=generator, dtype=T_wc.dtype)
    turn = sim3_exp(torch.cat([0 * axis, axis, axis.new_zeros(1)]))
    return rigid(turn[:3, :3], 2 * distance)


def _perturbed(exact: Tensor, sigmas: Tensor, generator: Generator, bias: float = 0.0) -> Tensor:
    """Measurements (n, 4, 4) with noise, and with one error, `bias` standard deviations large, that all share."""
    noise = torch.randn(len(exact), 7, generator=generator, dtype=exact.dtype)
    shared = torch.randn(7, generator=generator, dtype=exact.dtype)
    return sim3_exp(sigmas * (noise + bias * shared)) @ exact


def _sigmas(ranges: tuple[tuple[float, float], ...], generator: Generator) -> Tensor:
    drawn = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    t, r, s = (low * (high / low) ** share for share, (low, high) in zip(drawn, ranges, strict=True))
    return torch.tensor([t] * 3 + [r] * 3 + [s], dtype=torch.float64)


def _factor(at_most: float, generator: Generator) -> float:
    return at_most ** (2 * float(torch.rand(1, generator=generator)) - 1)
