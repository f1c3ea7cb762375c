"""What learned weights compete with, each with its settings: weights of loops from graphs alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import networkx
import torch
from torch import Tensor

from experiments.loop_trust.consistency import Consistency, consistency
from experiments.loop_trust.graphs import Graphs, ate, chi_squares, dead_reckoning, solve

CHI_SQUARE = 18.48  # 99 % of seven squared standard normal numbers lie below
_ROUNDS = 20  # of reweighting
_STEPS = 2  # of the solver in a round
_GROWTH = 1.4  # of the control parameter of GNC, as its authors have it
_GNC_ROUNDS = 60
_GNC_STEPS = 10  # in a round: with two, it lost genuine loops to what was not solved yet
_DIFFERENT = 1e-3  # between weights of two rounds that are not done
_CHUNK = 10  # graphs that are solved as one problem


class Method(Protocol):
    def __call__(self, graphs: Graphs) -> Tensor:
        """(G, K, 4, 4) nodes."""
        ...


@dataclass(frozen=True)
class Cauchy:
    """Least squares with the Cauchy kernel on the loops, `scale` in standard deviations."""

    scale: float

    def __call__(self, graphs: Graphs) -> Tensor:
        return reweighted(graphs, self)

    def weights(self, squared: Tensor) -> Tensor:
        return 1 / (1 + squared / self.scale**2)

    def __str__(self) -> str:
        return f"scale {self.scale:g}"


@dataclass(frozen=True)
class DynamicCovarianceScaling:
    """Weights min(1, 2 phi / (phi + chi²))². Source: Agarwal, Tipaldi, Spinello, Stachniss and Burgard, "Robust map
    optimization using dynamic covariance scaling", 2013.
    """

    phi: float

    def __call__(self, graphs: Graphs) -> Tensor:
        return reweighted(graphs, self)

    def weights(self, squared: Tensor) -> Tensor:
        return (2 * self.phi / (self.phi + squared)).clamp_max(1.0).square()

    def __str__(self) -> str:
        return f"phi {self.phi:g}"


def reweighted(graphs: Graphs, rule: Cauchy | DynamicCovarianceScaling) -> Tensor:
    """Nodes by iteratively reweighted least squares, from odometry."""
    S_cw = dead_reckoning(graphs)
    for _ in range(_ROUNDS):
        S_cw = solve(graphs, rule.weights(chi_squares(graphs, S_cw)), S_cw, _STEPS)
    return S_cw


@dataclass(frozen=True)
class GraduatedNonConvexity:
    """From least squares to a robust cost step by step; odometry is trusted. Source: Yang, Antonante, Tzoumas and
    Carlone, "Graduated non-convexity for robust spatial perception", 2020.

    bound: the largest chi² of a genuine loop; truncated: the truncated cost, else that of Geman and McClure
    """

    bound: float
    truncated: bool = True

    def __call__(self, graphs: Graphs) -> Tensor:
        weights = graphs.mask.to(graphs.loops.dtype)
        S_cw = solve(graphs, weights)
        squared = chi_squares(graphs, S_cw)
        worst = torch.where(graphs.mask, squared, 0.0).amax(-1, keepdim=True)
        if self.truncated:
            control = self.bound / (2 * worst - self.bound).clamp_min(1e-9)
            # Where nothing is beyond the bound, least squares was right.
            control = torch.where(2 * worst > self.bound, control, 1e6)
        else:
            control = (2 * worst / self.bound).clamp_min(1.0)
        for _ in range(_GNC_ROUNDS):
            before, weights = weights, self.weights(squared, control)
            S_cw = solve(graphs, weights, S_cw, _GNC_STEPS)
            squared = chi_squares(graphs, S_cw)
            done = (before - weights).abs()[graphs.mask].amax() < _DIFFERENT
            if self.truncated and done and bool(((weights < _DIFFERENT) | (weights > 1 - _DIFFERENT)).all()):
                break
            if not self.truncated and done and bool((control == 1).all()):
                break
            control = control * _GROWTH if self.truncated else (control / _GROWTH).clamp_min(1.0)
        return solve(graphs, weights, S_cw)

    def weights(self, squared: Tensor, control: Tensor) -> Tensor:
        if not self.truncated:
            return (control * self.bound / (control * self.bound + squared)).square()
        between = (self.bound * control * (control + 1) / squared.clamp_min(1e-12)).sqrt() - control
        inside = squared <= control / (control + 1) * self.bound
        outside = squared >= (control + 1) / control * self.bound
        return torch.where(inside, 1.0, torch.where(outside, 0.0, between))

    def __str__(self) -> str:
        return f"{'truncated' if self.truncated else 'Geman-McClure'}, chi² {self.bound:g}"


@dataclass(frozen=True)
class PairwiseConsistency:
    """The largest set of loops each two of which agree. Source: Mangelson and others, 2018, see `consistency`.

    bound: on the chi² of two loops; gated: loops that disagree with odometry by more are left out before
    """

    bound: float
    gated: bool = False

    def __call__(self, graphs: Graphs) -> Tensor:
        return solve(graphs, self.weights(graphs, agreement(graphs)))

    def weights(self, graphs: Graphs, agree: Consistency) -> Tensor:
        usable = graphs.mask & (agree.own <= self.bound) if self.gated else graphs.mask
        fits = (agree.pairwise <= self.bound) & usable[:, :, None] & usable[:, None]
        chosen = torch.zeros_like(graphs.mask)
        for row in range(len(graphs)):
            chosen[row, largest_clique(fits[row], usable[row])] = True
        return chosen.to(graphs.loops.dtype)

    def __str__(self) -> str:
        return f"chi² {self.bound:g}{', odometry checked too' if self.gated else ''}"


def largest_clique(fits: Tensor, usable: Tensor) -> list[int]:
    """Rows of the largest set in which every two fit (N, N), of those usable (N,)."""
    graph = networkx.Graph()
    graph.add_nodes_from(usable.nonzero()[:, 0].tolist())
    joined = fits & usable[:, None] & usable
    graph.add_edges_from(tuple(pair) for pair in joined.triu(1).nonzero().tolist())
    return sorted(networkx.max_weight_clique(graph, weight=None)[0])


def agreement(graphs: Graphs) -> Consistency:
    """How loops agree, seen from odometry."""
    return consistency(
        dead_reckoning(graphs), graphs.odometry_sigmas, graphs.pairs, graphs.loops, graphs.loop_sigmas
    )


@dataclass(frozen=True)
class Everything:
    """Least squares over all loops."""

    def __call__(self, graphs: Graphs) -> Tensor:
        return solve(graphs, graphs.mask.to(graphs.loops.dtype))


@dataclass(frozen=True)
class Odometry:
    """No loop at all."""

    def __call__(self, graphs: Graphs) -> Tensor:
        return dead_reckoning(graphs)


@dataclass(frozen=True)
class Oracle:
    """Least squares over the genuine loops, which nobody knows."""

    def __call__(self, graphs: Graphs) -> Tensor:
        return solve(graphs, graphs.genuine.to(graphs.loops.dtype))


def candidates() -> dict[str, list[Method]]:
    """Per competitor, all its settings; graphs of the training families choose."""
    bounds = [factor * CHI_SQUARE for factor in (1.0, 4.0, 16.0)]
    return {
        "Cauchy": [Cauchy(scale) for scale in (1.0, 2.0, 4.0, 8.0)],
        "DCS": [DynamicCovarianceScaling(phi) for phi in (5.0, 20.0, 80.0, 320.0)],
        "GNC": [
            *(GraduatedNonConvexity(bound) for bound in bounds),
            GraduatedNonConvexity(bounds[1], truncated=False),
        ],
        "PCM": [
            PairwiseConsistency(factor * CHI_SQUARE, gated)
            for factor in (1.0, 4.0, 16.0, 64.0)
            for gated in (False, True)
        ],
    }


@torch.no_grad()
def nodes_of(method: Method, graphs: Graphs) -> Tensor:
    """(G, K, 4, 4) what a method finds, some graphs at a time."""
    return torch.cat([method(graphs[start : start + _CHUNK]) for start in range(0, len(graphs), _CHUNK)])


def choose(methods: list[Method], graphs: Graphs) -> Method:
    """The method with the lowest geometric mean of the ATE."""

    def mean(method: Method) -> float:
        error = float(ate(nodes_of(method, graphs), graphs.S_cw_true).log().mean())
        return error if math.isfinite(error) else math.inf

    return min(methods, key=mean)
