"""What came out, in tables: ratios to the hand-set rule, with intervals over sequences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import fmean, stdev

from experiments.common import table
from experiments.noise_model.runs import Outcome
from experiments.noise_model.same_graph import Figures

HAND, STATED, LEVEL, LIKELIHOOD, SHAPE, TRAJECTORY, OWN = (
    "hand-set",
    "stated",
    "level, fitted",
    "likelihood",
    "shape",
    "trajectory",
    "its own trajectory",
)
RULES = (HAND, LEVEL, LIKELIHOOD, SHAPE, TRAJECTORY, OWN)
"""hand-set: one noise per level, not stated. stated: the same, said, half as large: tests stay as they are and
only the kernel bends earlier. level, fitted: as large as is most likely. likelihood: learned on the other sequences.
shape: likewise, but every image has the level of "stated", and directions are alike. trajectory: that, moved on by the
trajectories of the other sequences; its own trajectory: by that of the run that it is measured on."""
RENDERED = "synthetic:"
STUDENT = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)
"""97.5 % of Student's t, of one to nine degrees of freedom."""

WHOLE = 0.95
"""Share of the frames posed without which an ATE is not compared: it is that of another, shorter path."""

Cells = dict[str, dict[str, dict[int, Figures]]]
"""Of each sequence, rule and seed."""
Runs = dict[str, dict[str, dict[int, Outcome]]]


def mean_log(numbers: Iterable[float]) -> float:
    return fmean(math.log(each) for each in numbers)


def geometric_mean(logs: Sequence[float]) -> str:
    """Of ratios given by their logarithms, one of each sequence, with the 95 % interval of Student's t."""
    middle = fmean(logs)
    if len(logs) < 2:
        return f"{math.exp(middle):.3f}"
    reach = STUDENT[len(logs) - 2] * stdev(logs) / math.sqrt(len(logs))
    return f"{math.exp(middle):.3f} ({math.exp(middle - reach):.3f} to {math.exp(middle + reach):.3f})"


def overall(logs: dict[str, float]) -> str:
    """Over the sequences that are not rendered, and how many these are."""
    found = [value for name, value in logs.items() if not name.startswith(RENDERED)]
    return f"{geometric_mean(found)} of {len(found)}" if found else ""


def _mean(figures: Iterable[float | None], form: str) -> str:
    found = [each for each in figures if each is not None]
    return f"{fmean(found):{form}}" if found else ""


def graph_table(cells: Cells) -> str:
    """Two tables: what the error is made of, and what other weights do to the same observations."""
    rows, without = [], {}
    for name, cell in cells.items():
        hand, learned = cell[HAND].values(), cell[LIKELIHOOD].values()
        share = next(iter(hand)).noise_share
        if share is not None:
            without[name] = 0.5 * math.log1p(-share)
        rows.append(
            [
                _name(name),
                _mean((1e3 * each.ate_m for each in hand if each.ate_m), ".2f"),
                "" if share is None else f"{share:.1%}",
                "" if share is None else f"{math.sqrt(1 - share):.3f}",
                *(_mean((each.nees for each in part), ".1f") for part in (hand, learned)),
                *(_mean((each.nees_halves for each in part), ".2f") for part in (hand, learned)),
            ]
        )
    rows.append(["**all real ones**", "", "", overall(without), "", "", "", ""])
    header = ["sequence", "ATE (mm)", "of its square, noise", "without it, ratio", "NEES", "NEES: likelihood"]
    header += ["NEES of halves", "of halves: likelihood"]
    return table(header, rows) + "\n" + _ratios(cells)


def _ratios(cells: Cells) -> str:
    rules = [rule for rule in RULES if rule != HAND]
    ates: dict[str, dict[str, float]] = {rule: {} for rule in rules}
    aparts: dict[str, dict[str, float]] = {rule: {} for rule in rules}
    for name, cell in cells.items():
        hand = next(iter(cell[HAND].values()))
        for rule in rules:
            found = cell[rule].values()
            if found:
                logs = [
                    mean_log(x / y for x, y in zip(each.apart, hand.apart, strict=True)) for each in found
                ]
                aparts[rule][name] = fmean(logs)
            if found and hand.ate_m is not None:
                ates[rule][name] = mean_log(each.ate_m / hand.ate_m for each in found if each.ate_m)
    columns = [(label, logs[rule]) for label, logs in (("ATE", ates), ("halves", aparts)) for rule in rules]
    columns = [
        (f"{label}: {rule}", logs) for (label, logs), rule in zip(columns, [*rules, *rules], strict=True)
    ]
    rows = [[_name(name), *(_ratio(logs.get(name)) for _, logs in columns)] for name in cells]
    rows.append(["**all real ones**", *(overall(logs) for _, logs in columns)])
    return table(["sequence", *(label for label, _ in columns)], rows)


def _ratio(log: float | None) -> str:
    return "" if log is None else f"{math.exp(log):.3f}"


def run_table(runs: Runs) -> str:
    """Whole runs by each rule, and what their errors are of those by the hand-set rule with the same seeds."""
    logs: dict[str, dict[str, float]] = {}
    rows = []
    for name, cell in runs.items():
        hand = cell[HAND]
        for rule, found in cell.items():
            if not found:
                continue
            common = [
                seed for seed in found if seed in hand and is_whole(found[seed]) and is_whole(hand[seed])
            ]
            if common:
                pairs = [found[seed].ate_m / hand[seed].ate_m for seed in common]
                logs.setdefault(rule, {})[name] = mean_log(pairs)
            rows.append(
                [
                    _name(name),
                    rule,
                    ", ".join(f"{1e3 * each.ate_m:.4g}" for each in found.values()),
                    _ratio(logs[rule][name]) if common and rule != HAND else "",
                    ", ".join(f"{each.posed}" for each in found.values()) + f" of {found[min(found)].frames}",
                    _mean((each.nees for each in found.values()), ".1f"),
                ]
            )
    rows += [["**all real ones**", rule, "", overall(logs[rule]), "", ""] for rule in logs if rule != HAND]
    return table(["sequence", "rule", "ATE (mm) by seed", "ratio", "posed", "NEES"], rows)


def is_whole(outcome: Outcome) -> bool:
    return outcome.posed >= WHOLE * outcome.frames


def _name(name: str) -> str:
    return "rendered room" if name.startswith(RENDERED) else name
