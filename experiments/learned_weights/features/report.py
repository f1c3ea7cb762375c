"""Tables of the measurements: medians, and ratios with intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.common import interval_of, table
from experiments.learned_weights.features.evaluation import PairErrors

BLOCK = 5  # neighboring pairs that are drawn together: they see much of the same
DRAWS = 4000
ERRORS = ("rotation error", "direction error", "rotation between halves", "direction between halves")


@dataclass(frozen=True)
class Result:
    """The errors of a feature extractor on one part of a sequence.

    pairs:     errors of pairs
    positions: (C,) ATE of clips as a share of the path, NaN where too few frames are posed
    """

    pairs: PairErrors
    positions: Tensor


Results = dict[str, dict[str, Result]]  # by feature extractor and part


def medians(results: Results) -> str:
    """A table by part and feature extractor."""
    rows = []
    for name in next(iter(results.values())):
        for label, parts in results.items():
            pairs, positions = parts[name].pairs, parts[name].positions
            rotation, direction, rotation_halves, direction_halves = pairs.angles.nanmedian(
                -1
            ).values.tolist()
            posed = int((~positions.isnan()).sum())
            rows.append(
                [
                    name,
                    label,
                    f"{float(pairs.inliers.mean()):.0f}",
                    f"{1e3 * rotation:.2f}",
                    f"{math.degrees(direction):.2f}",
                    f"{1e3 * rotation_halves:.2f}",
                    f"{math.degrees(direction_halves):.2f}",
                    f"{posed} of {len(positions)}",
                    f"{100 * float(positions.nanmedian()):.2f} %" if posed else "",
                ]
            )
    header = ["unseen", "feature extractor", "inliers a pair", "rotation error (mrad)", "direction error (°)"]
    halves = ["halves: rotation (mrad)", "direction (°)"]
    return table([*header, *halves, "clips posed", "ATE / path"], rows)


def ratios(before: dict[str, Result], after: dict[str, Result]) -> str:
    """A table of geometric means of after / before, by error and part and over all, with 95 % intervals.

    Clips may be missing from `after`.
    """
    columns: dict[str, dict[str, Tensor]] = {error: {} for error in (*ERRORS, "ATE / path")}
    for name in before:
        logs = (after[name].pairs.angles / before[name].pairs.angles).log()
        for error, row in zip(ERRORS, logs, strict=True):
            columns[error][name] = row
        if len(after[name].positions):
            columns["ATE / path"][name] = (after[name].positions / before[name].positions).log()
    rows = []
    for error, parts in columns.items():
        if not parts:
            continue
        block = 1 if error == "ATE / path" else BLOCK
        cells = [ratio([part], block) for part in parts.values()]
        rows.append([error, *cells, ratio(list(parts.values()), block)])
    inliers = [float(after[name].pairs.inliers.sum() / before[name].pairs.inliers.sum()) for name in before]
    mean = math.prod(inliers) ** (1 / len(inliers))
    rows.append(["inliers", *(f"{share:.3f}" for share in inliers), f"{mean:.3f}"])
    return table(["trained / not", *before, "all"], rows)


def ratio(logs: list[Tensor], block: int) -> str:
    """Format the geometric mean over what both posed, and its interval."""
    kept = [part[~part.isnan()] for part in logs]
    if not sum(len(part) for part in kept):
        return ""
    mean = float(torch.cat(kept).mean().exp())
    low, high = bootstrap(kept, block)
    return f"{mean:.2f} ({low:.2f} to {high:.2f})"


def bootstrap(logs: list[Tensor], block: int) -> tuple[float, float]:
    """95 % interval of the exponential of the mean of several parts' values, resampled within each part.

    Runs of `block` neighbors are drawn as one.
    """
    generator = torch.Generator().manual_seed(0)
    totals, counts = torch.zeros(DRAWS, dtype=torch.float64), torch.zeros(DRAWS, dtype=torch.float64)
    for part in logs:
        if not len(part):
            continue
        runs = part.double().split(block)
        sums = torch.stack([run.sum() for run in runs])
        sizes = torch.tensor([len(run) for run in runs], dtype=torch.float64)
        drawn = torch.randint(len(runs), (DRAWS, len(runs)), generator=generator)
        totals, counts = totals + sums[drawn].sum(-1), counts + sizes[drawn].sum(-1)
    return interval_of((totals / counts).exp())
