"""What came out, in tables: ATE by family of graphs, ratios with their spread over seeds and intervals over graphs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.common import table

COMPETITORS = ("Cauchy", "DCS", "GNC", "PCM")
LEARNED, ORACLE = "learned", "oracle"
FAILED = 2.0  # times the oracle's ATE: a false loop got in, or too many were refused
_DRAWS = 1000

Errors = dict[str, Tensor]
"""By method the ATE (S, G) of G graphs: of S seeds, one where nothing is trained."""


@dataclass(frozen=True)
class Ratio:
    """Of geometric means of ATE: mean and standard deviation over seeds, and 95 % when graphs are drawn anew."""

    mean: float
    deviation: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.2f} ± {self.deviation:.2f} ({self.low:.2f} to {self.high:.2f})"


def best_of(cells: list[Errors]) -> str:
    """The competitor with the lowest ATE, geometric mean over graphs and cells."""
    return min(COMPETITORS, key=lambda name: sum(float(cell[name].log().mean()) for cell in cells))


def ratio(cells: list[Errors], method: str, reference: str) -> Ratio:
    """What a method's ATE is of the reference's, over cells that count alike."""
    generator = torch.Generator().manual_seed(0)
    logs = [cell[method].log() - cell[reference].log() for cell in cells]
    seeds = torch.stack([log.mean(-1) for log in logs]).mean(0)
    drawn = torch.zeros(_DRAWS, dtype=torch.float64)
    for log in logs:
        per_graph = log.mean(0)
        rows = torch.randint(len(per_graph), (_DRAWS, len(per_graph)), generator=generator)
        drawn += per_graph[rows].mean(-1) / len(logs)
    low, high = drawn.quantile(drawn.new_tensor([0.025, 0.975])).exp().tolist()
    spread = float(seeds.exp().std()) if len(seeds) > 1 else 0.0
    return Ratio(math.exp(float(seeds.mean())), spread, low, high)


def error_table(cells: dict[str, Errors]) -> str:
    """A row per cell and one over all: ATE in steps, and the learned ATE and the oracle's as shares of the best."""
    methods = [name for name in next(iter(cells.values())) if name not in (LEARNED, ORACLE)]
    header = ["graphs", *methods, LEARNED, ORACLE, "best", "learned / best", "oracle / best"]
    rows = []
    for name, cell in cells.items():
        best = best_of([cell])
        means = [f"{float(cell[m].log().mean().exp()):.3f}" for m in (*methods, LEARNED, ORACLE)]
        bound = f"{ratio([cell], ORACLE, best).mean:.2f}"
        rows.append([name, *means, best, str(ratio([cell], LEARNED, best)), bound])
    every = list(cells.values())
    best = best_of(every)
    means = [
        f"{math.exp(sum(float(c[m].log().mean()) for c in every) / len(every)):.3f}"
        for m in (*methods, LEARNED, ORACLE)
    ]
    bound = f"{ratio(every, ORACLE, best).mean:.2f}"
    rows.append(["**all**", *means, best, str(ratio(every, LEARNED, best)), bound])
    return table(header, rows)


def failure_table(cells: dict[str, Errors]) -> str:
    """The share of graphs, per cent, whose ATE is more than twice the oracle's."""
    methods = [name for name in next(iter(cells.values())) if name != ORACLE]
    rows = [
        [name, *(f"{100 * float((c[m] > FAILED * c[ORACLE]).double().mean()):.0f}" for m in methods)]
        for name, c in cells.items()
    ]
    return table(["graphs", *methods], rows)
