"""Tables of the results: medians by part, gains with their spread over seeds and intervals over problems."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.common import interval_of, table
from experiments.learned_weights.matches.evaluation import pose_errors, relative_errors
from experiments.learned_weights.matches.problems import Problems

COMPETITORS = ("uniform weights", "best kernel", "RANSAC")
_DRAWS = 1000
_BLOCK_S = 1.0  # problems that begin in the same second share frames: they are drawn together


@dataclass(frozen=True)
class PartResult:
    """Errors on one part by method: (S, P, 2) meters and radians of S seeds, one where nothing is trained."""

    problems: Problems
    errors: dict[str, Tensor]

    @staticmethod
    def of(problems: Problems, poses: dict[str, list[Tensor]], T_true: Tensor) -> PartResult:
        errors = {
            label: torch.stack([pose_errors(T_cw=T, T_cw_groundtruth=T_true) for T in seeds])
            for label, seeds in poses.items()
        }
        return PartResult(problems, errors)

    def relative(self) -> dict[str, Tensor]:
        """(S, P)"""
        return {label: relative_errors(errors, self.problems) for label, errors in self.errors.items()}

    def blocks(self) -> Tensor:
        """(P,) int64, the block of time of each problem."""
        return torch.unique((self.problems.spans[:, 0] / _BLOCK_S).floor(), return_inverse=True)[1]


def _log_gains(relatives: list[dict[str, Tensor]]) -> Tensor:
    """(S,) learned against the best competitor: logarithm of the ratio of medians, each a geometric mean of parts."""

    def score(label: str) -> Tensor:
        return torch.stack([relative[label].median(-1).values.log() for relative in relatives]).mean(0)

    return score("learned") - torch.stack([score(label) for label in COMPETITORS]).amin()


def _interval(parts: list[PartResult], seed: int = 0) -> tuple[float, float]:
    """95 % interval of the mean gain over seeds, by a bootstrap over blocks of problems within each part."""
    generator = torch.Generator().manual_seed(seed)
    relatives = [part.relative() for part in parts]
    members = []
    for part in parts:
        blocks = part.blocks()
        members.append([torch.nonzero(blocks == block)[:, 0] for block in range(int(blocks.max()) + 1)])
    means = []
    for _ in range(_DRAWS):
        drawn = []
        for relative, rows in zip(relatives, members, strict=True):
            chosen = torch.randint(len(rows), (len(rows),), generator=generator).tolist()
            take = torch.cat([rows[block] for block in chosen])
            drawn.append({label: values[:, take] for label, values in relative.items()})
        means.append(_log_gains(drawn).mean())
    low, high = interval_of(torch.stack(means))
    return math.expm1(low), math.expm1(high)


def gain(parts: list[PartResult]) -> str:
    """The mean over seeds, their standard deviation, and the interval."""
    gains = _log_gains([part.relative() for part in parts]).expm1()
    spread = f" ± {100 * float(gains.std()):.1f}" if len(gains) > 1 else ""
    mean = f"{100 * float(gains.mean()):+.1f}{spread} %"
    if max(int(part.blocks().max()) for part in parts) == 0:
        return mean  # a single block does not determine the spread
    low, high = _interval(parts)
    return f"{mean} ({100 * low:+.0f} to {100 * high:+.0f})"


def error_table(parts: dict[str, PartResult]) -> str:
    """Medians of every part and method, and what learning gains."""
    labels = list(next(iter(parts.values())).errors)
    rows = [
        [name, f"{len(part.problems)}", *(_cell(part.errors[label]) for label in labels), gain([part])]
        for name, part in parts.items()
    ]
    header = ["part", "problems", *labels, "gain"]
    if len(parts) == 1:
        return table(header, rows)
    relatives = [part.relative() for part in parts.values()]
    means = [
        math.exp(
            sum(float(relative[label].median(-1).values.log().mean()) for relative in relatives) / len(parts)
        )
        for label in labels
    ]
    cells = [f"{1e3 * mean:.2f}e-3" for mean in means]
    rows.append(["relative error, geometric mean", "", *cells, gain(list(parts.values()))])
    return table(header, rows)


def _cell(errors: Tensor) -> str:
    """Format median errors (S, P, 2), averaged over seeds."""
    meters, radians = errors.median(1).values.mean(0).tolist()
    return f"{100 * meters:.2f} cm, {math.degrees(radians):.3f}°"
