"""What came out, in tables: ratios to the hand-set rule, with intervals over sequences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import fmean, stdev

from experiments.common import table
from experiments.noise_model.runs import Outcome
from experiments.noise_model.same_graph import Figures

HAND, LEVEL, LIKELIHOOD, TRAJECTORY, OWN = (
    "hand-set",
    "level, fitted",
    "likelihood",
    "trajectory",
    "its own trajectory",
)
RULES = (HAND, LEVEL, LIKELIHOOD, TRAJECTORY, OWN)
"""hand-set: one noise per level, not stated; level, fitted: the same, stated, as large as is most likely; likelihood,
trajectory: learned on the other sequences; its own trajectory: learned on the very run it is measured on, a bound."""
RENDERED = "synthetic:"
STUDENT = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)
"""97.5 % of Student's t, of one to nine degrees of freedom."""

Cells = dict[str, dict[str, list[Figures]]]
"""Of each sequence and rule, the figures of all seeds."""
Runs = dict[str, dict[str, list[Outcome]]]


def mean_log(numbers: Iterable[float]) -> float:
    return fmean(math.log(each) for each in numbers)


def geometric_mean(logs: Sequence[float]) -> str:
    """Of ratios given by their logarithms, one of each sequence, with the 95 % interval of Student's t."""
    middle = fmean(logs)
    if len(logs) < 2:
        return f"{math.exp(middle):.3f}"
    reach = STUDENT[len(logs) - 2] * stdev(logs) / math.sqrt(len(logs))
    return f"{math.exp(middle):.3f} ({math.exp(middle - reach):.3f} to {math.exp(middle + reach):.3f})"


def real(logs: dict[str, float]) -> list[float]:
    """Those of sequences that are not rendered."""
    return [value for name, value in logs.items() if not name.startswith(RENDERED)]


def _known(figures: Iterable[float | None]) -> list[float]:
    return [each for each in figures if each is not None]


def graph_table(cells: Cells) -> str:
    """Two tables: what the error is made of, and what other weights do to the same observations."""
    made_of = []
    for name, cell in cells.items():
        (hand,), likelihood, level = cell[HAND], cell[LIKELIHOOD], cell[LEVEL]
        gain = fmean(_known(each.loss for each in level)) - fmean(_known(each.loss for each in likelihood))
        first, learned = hand, likelihood
        row = [
            _name(name),
            "",
            "",
            "",
            "",
            f"{hand.nees_halves:.2f}",
            f"{fmean(x.nees_halves for x in learned):.2f}",
        ]
        if first.ate_m is not None and first.nees is not None and first.noise_share is not None:
            nees = fmean(_known(each.nees for each in learned))
            row[1:5] = (
                f"{1e3 * first.ate_m:.2f}",
                f"{first.noise_share:.0%}",
                f"{first.nees:.1f}",
                f"{nees:.1f}",
            )
        made_of.append([*row, f"{gain:.3f}"])
    header = ["sequence", "ATE (mm)", "of its square, noise", "NEES", "NEES, likelihood", "NEES of halves"]
    header += ["of halves, likelihood", "likelihood gained per observation"]
    return table(header, made_of) + "\n" + _ratios(cells)


def _ratios(cells: Cells) -> str:
    rules = [rule for rule in RULES if rule != HAND]
    ates: dict[str, dict[str, float]] = {rule: {} for rule in rules}
    aparts: dict[str, dict[str, float]] = {rule: {} for rule in rules}
    rows = []
    for name, cell in cells.items():
        (hand,) = cell[HAND]
        for rule in rules:
            pairs = [zip(each.apart, hand.apart, strict=True) for each in cell[rule]]
            aparts[rule][name] = fmean(mean_log(one / other for one, other in pair) for pair in pairs)
            if hand.ate_m is not None:
                ates[rule][name] = mean_log(each / hand.ate_m for each in _known(x.ate_m for x in cell[rule]))
        rows.append(
            [
                _name(name),
                *(f"{math.exp(ates[rule][name]):.3f}" if name in ates[rule] else "" for rule in rules),
                *(f"{math.exp(aparts[rule][name]):.3f}" for rule in rules),
            ]
        )
    means = [geometric_mean(real(logs[rule])) for logs in (ates, aparts) for rule in rules]
    header = ["sequence", *(f"ATE: {rule}" for rule in rules), *(f"halves: {rule}" for rule in rules)]
    return table(header, [*rows, ["**all real ones**", *means]])


def run_table(runs: Runs) -> str:
    """Whole runs by each rule, and what their errors are of those by the hand-set rule."""
    rules = list(next(iter(runs.values())))
    logs: dict[str, dict[str, float]] = {rule: {} for rule in rules}
    rows = []
    for name, cell in runs.items():
        for rule in rules:
            logs[rule][name] = mean_log(each.ate_m for each in cell[rule]) - mean_log(
                x.ate_m for x in cell[HAND]
            )
        rows.append(
            [
                _name(name),
                str(len(cell[HAND])),
                *(_errors(cell[rule]) for rule in rules),
                *(f"{math.exp(logs[rule][name]):.3f}" for rule in rules if rule != HAND),
                *(_posed(cell[rule]) for rule in rules),
                *(_nees(cell[rule]) for rule in rules),
            ]
        )
    means = [geometric_mean(real(logs[rule])) for rule in rules if rule != HAND]
    header = ["sequence", "seeds", *(f"ATE (mm): {rule}" for rule in rules)]
    header += [f"ratio: {rule}" for rule in rules if rule != HAND]
    header += [f"posed: {rule}" for rule in rules] + [f"NEES: {rule}" for rule in rules]
    empty = [""] * len(rules)
    return table(header, [*rows, ["**all real ones**", "", *empty, *means, *empty, *empty]])


def _errors(outcomes: list[Outcome]) -> str:
    return ", ".join(f"{1e3 * each.ate_m:.4g}" for each in outcomes)


def _posed(outcomes: list[Outcome]) -> str:
    return f"{fmean(each.posed / each.frames for each in outcomes):.1%}"


def _nees(outcomes: list[Outcome]) -> str:
    found = _known(each.nees for each in outcomes)
    return f"{fmean(found):.1f}" if found else ""


def _name(name: str) -> str:
    return "rendered room" if name.startswith(RENDERED) else name
