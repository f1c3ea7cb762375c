"""Tabulate the error rates of the decisions in the results of `run`. See README.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.common import parser_of, table, write_between
from experiments.decisions.cases import HALVES, KINDS
from experiments.decisions.run import commit, file_of, records
from torchslam.batch import Columns

EXACT = 2e-3
"""Relative error up to which a given focal length counts as exact: machine_hall's two differ by .003 themselves."""
OFF = 0.03
"""Relative error from which on a given focal length counts as wrong."""
CHANGED, FOUND = 0.01, 0.015
"""Relative errors of the final focal length: beyond the first an exact one was changed, below the second a wrong one
was found."""
ROLLING_MS = 15.0
"""Readout from which on a rolling shutter should be found, in milliseconds."""
READOUT_ERROR_MS = 3.0
"""Error up to which a readout that was found is right, in milliseconds."""
RIGHT, WRONG = 0.02, 0.05
"""Shares of the extent of the true path: a map with a smaller ATE than the first, without a misplaced pose, is right;
one with a larger ATE than the second, or a misplaced pose, is wrong. Others are neither."""
MIN_COMPARED = 5
"""Poses with a true one from which on a map is judged: fewer fit any path."""
WORSE = 1.05
"""Ratio of the final ATE to the online one of the same frames, from which on the run ended worse."""
Z = 1.959964
"""Standard deviations of a 95 % interval."""


@dataclass(frozen=True)
class Counted:
    """How often something happened.

    Attributes:
        count: number of cases (or frames) in which it did
        total: number in which it could
        names: of the cases that are errors
    """

    count: int
    total: int
    names: tuple[str, ...] = ()

    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the rate. Wilson, "Probable inference", 1927."""
        n, rate, z = self.total, self.count / self.total, Z
        middle = (rate + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
        return max(middle - half, 0.0), min(middle + half, 1.0)

    def cell(self) -> str:
        """Count, rate and interval; a dash where there were no cases."""
        if not self.total:
            return "-"
        low, high = self.interval()
        return f"{self.count} of {self.total}: {self.count / self.total:.0%} ({low:.0%} to {high:.0%})"


Outcome = bool | None
"""Whether something happened in a case; None where it could not."""


def focal_error(case: Columns, focal: float) -> float | None:
    """Relative error of a focal length; None where the true one is unknown."""
    true = case["truth"]["focal"]
    return None if true is None else abs(focal / true - 1.0)


def is_given_exact(case: Columns) -> bool:
    """Whether the given camera is the true one."""
    error = focal_error(case, case["given"]["focal"])
    return error is not None and error <= EXACT


def is_given_off(case: Columns) -> bool:
    """Whether the given focal length is off by `OFF` or more."""
    error = focal_error(case, case["given"]["focal"])
    return error is not None and error >= OFF


def exact_changed_online(case: Columns) -> Outcome:
    return any(change["is_camera"] for change in case["changes"]) if is_given_exact(case) else None


def exact_changed_online_much(case: Columns) -> Outcome:
    given = case["given"]["focal"]
    off = (abs(change["focal"] / given - 1.0) > CHANGED for change in case["changes"])
    return any(off) if is_given_exact(case) else None


def exact_changed_finally(case: Columns) -> Outcome:
    if not is_given_exact(case) or case["failure"]:
        return None
    error = focal_error(case, case["final"]["focal"])
    return error is not None and error > CHANGED


def global_found_online(case: Columns) -> Outcome:
    if case["truth"]["readout_ms"] != 0:
        return None
    return any(change["readout_ms"] is not None for change in case["changes"])


def global_found_finally(case: Columns) -> Outcome:
    if case["truth"]["readout_ms"] != 0 or case["failure"]:
        return None
    return case["final"]["readout_ms"] is not None


def off_corrected_online(case: Columns) -> Outcome:
    """A change of the camera online that brought the focal length nearer to the true one."""
    if not is_given_off(case):
        return None
    true, given = case["truth"]["focal"], case["given"]["focal"]
    moves = [change["focal"] for change in case["changes"] if change["is_camera"]]
    return bool(moves) and abs(moves[-1] / true - 1.0) < abs(given / true - 1.0)


def off_found(case: Columns) -> Outcome:
    if not is_given_off(case) or case["failure"]:
        return None
    error = focal_error(case, case["final"]["focal"])
    return error is not None and error < FOUND


def _is_rolling(case: Columns) -> bool:
    true = case["truth"]["readout_ms"]
    return true is not None and abs(true) >= ROLLING_MS


def rolling_found_online(case: Columns) -> Outcome:
    if not _is_rolling(case):
        return None
    return any(change["readout_ms"] is not None for change in case["changes"])


def rolling_found(case: Columns) -> Outcome:
    if not _is_rolling(case) or case["failure"]:
        return None
    return case["final"]["readout_ms"] is not None


def rolling_right(case: Columns) -> Outcome:
    if not rolling_found(case):
        return None
    return abs(case["final"]["readout_ms"] - case["truth"]["readout_ms"]) <= READOUT_ERROR_MS


def focal_within(sigmas: float) -> Callable[[Columns], Outcome]:
    """Whether the true focal length is within so many standard errors; that of the truth is added."""

    def outcome(case: Columns) -> Outcome:
        final, truth = case["final"], case["truth"]
        if truth["focal"] is None or final["focal_std"] is None or case["failure"]:
            return None
        std = math.hypot(final["focal_std"], truth["focal_std"] * truth["focal"])
        return abs(final["focal"] - truth["focal"]) <= sigmas * std

    return outcome


def readout_within(sigmas: float) -> Callable[[Columns], Outcome]:
    """Whether the true readout is within so many standard errors of one that was found, for an exact truth."""

    def outcome(case: Columns) -> Outcome:
        true, final = case["truth"]["readout_ms"], case["final"]
        if not true or case["kind"] != "rendered" or final["readout_ms"] is None:
            return None
        return abs(final["readout_ms"] - true) <= sigmas * final["readout_std_ms"]

    return outcome


def _is_judged(case: Columns) -> bool:
    return bool(case["errors"]) and case["errors"]["compared"] >= MIN_COMPARED


def is_right(case: Columns) -> bool:
    """Whether the final map of a case is right by the truth."""
    if not _is_judged(case):
        return False
    errors = case["errors"]
    return errors["ate"] < RIGHT * errors["extent"] and not errors["misplaced"]


def is_wrong(case: Columns) -> bool:
    """Whether the final map of a case is wrong by the truth."""
    if not _is_judged(case):
        return False
    errors = case["errors"]
    return errors["ate"] > WRONG * errors["extent"] or bool(errors["misplaced"])


def no_map(case: Columns) -> Outcome:
    return bool(case["failure"])


def half_lost(case: Columns) -> Outcome:
    return None if case["failure"] else case["posed"] < 0.5 * case["frames"]


def map_wrong(case: Columns) -> Outcome:
    return is_wrong(case) if _is_judged(case) else None


def right_called_wrong(case: Columns) -> Outcome:
    return not case["check"]["is_right"] if is_right(case) and case["check"] else None


def right_doubted(case: Columns) -> Outcome:
    """Some frames are uncertain by the check that were not while they were tracked."""
    if not is_right(case) or not case["check"]:
        return None
    return case["check"]["uncertain_frames"] > case["check"]["uncertain_online"]


def wrong_called_wrong(case: Columns) -> Outcome:
    return not case["check"]["is_right"] if is_wrong(case) and case["check"] else None


def ended_worse(case: Columns) -> Outcome:
    if not _is_judged(case):
        return None
    return case["errors"]["ate_final"] > WORSE * case["errors"]["ate_online"]


def ended_worse_not_right(case: Columns) -> Outcome:
    """The same for maps that are not right at the end."""
    return ended_worse(case) if _is_judged(case) and not is_right(case) else None


def _has_zoom(case: Columns) -> bool:
    return case["final"].get("zoom_extent") is not None


def zoom_found_without(case: Columns) -> Outcome:
    """A zoom found where there is none."""
    return None if case["kind"] == "zoomed" or case["failure"] else _has_zoom(case)


def zoom_found(case: Columns) -> Outcome:
    """A zoom that is found."""
    return _has_zoom(case) if case["kind"] == "zoomed" and not case["failure"] else None


def zoom_overlooked(case: Columns) -> Outcome:
    """A zoomed recording whose path is off by more than 5 %, without a frame that is uncertain."""
    if case["kind"] != "zoomed" or not case["errors"]:
        return None
    return case["errors"]["ate"] > 0.05 * case["errors"]["extent"] and not case["states"].get("uncertain")


def of_cases(outcome: Callable[[Columns], Outcome], is_error: bool) -> Callable[[Sequence[Columns]], Counted]:
    """Count the cases in which something happened; `is_error`: that it did, otherwise that it did not."""

    def count(cases: Sequence[Columns]) -> Counted:
        found = {case["name"]: outcome(case) for case in cases}
        able = {name: happened for name, happened in found.items() if happened is not None}
        names = tuple(name for name, happened in able.items() if happened == is_error)
        return Counted(sum(able.values()), len(able), names)

    return count


def uncertain_frames(cases: Sequence[Columns]) -> Counted:
    """Frames of right maps that are uncertain after the check."""
    checks = {case["name"]: case["check"] for case in cases if is_right(case) and case["check"]}
    names = tuple(name for name, check in checks.items() if check["uncertain_frames"])
    count, total = (sum(check[key] for check in checks.values()) for key in ("uncertain_frames", "frames"))
    return Counted(count, total, names)


def _bent(cases: Iterable[Columns], low: float, high: float) -> list[tuple[str, Columns]]:
    """Bent maps of cases that were right before, with a deformation in a range."""
    return [
        (f"{case['name']} {scale}", bent)
        for case in cases
        if is_right(case) and case["check"] and case["check"]["is_right"]
        for scale, bent in case["bent"].items()
        if low <= bent["deformation"] < high
    ]


def bent_found(low: float, high: float = math.inf) -> Callable[[Sequence[Columns]], Counted]:
    """Count the bent maps that the check calls not right, of those deformed by a share of the extent in a range."""

    def count(cases: Sequence[Columns]) -> Counted:
        bent = _bent(cases, low, high)
        missed = tuple(name for name, one in bent if one["is_right"])
        return Counted(len(bent) - len(missed), len(bent), missed)

    return count


def bent_keyframes(cases: Sequence[Columns]) -> Counted:
    """Keyframes of the half of a bent map that the check doubts more, and those of them that are uncertain."""
    bent = _bent(cases, RIGHT, math.inf)
    count = total = 0
    names = []
    for name, one in bent:
        doubted, number = max(
            zip(one["uncertain"], one["halves"], strict=True), key=lambda each: each[0] / each[1]
        )
        count, total = count + doubted, total + number
        if not doubted:
            names.append(name)
    return Counted(count, total, tuple(names))


ROWS: dict[str, Callable[[Sequence[Columns]], Counted]] = {
    "no map": of_cases(no_map, True),
    "fewer than half of the frames posed": of_cases(half_lost, True),
    "exact camera changed online": of_cases(exact_changed_online, True),
    "exact camera changed online by more than 1 %": of_cases(exact_changed_online_much, True),
    "exact camera changed by more than 1 % at the end": of_cases(exact_changed_finally, True),
    "global shutter: readout found online": of_cases(global_found_online, True),
    "global shutter: readout found at the end": of_cases(global_found_finally, True),
    "camera off by 3 % and more: corrected online": of_cases(off_corrected_online, False),
    "camera off by 3 % and more: within 1.5 % at the end": of_cases(off_found, False),
    "readout of 15 ms and more: found online": of_cases(rolling_found_online, False),
    "readout of 15 ms and more: found at the end": of_cases(rolling_found, False),
    "readout of 15 ms and more, found: right to 3 ms": of_cases(rolling_right, False),
    "true focal length within one stated error": of_cases(focal_within(1.0), False),
    "true focal length within two": of_cases(focal_within(2.0), False),
    "true readout within one stated error": of_cases(readout_within(1.0), False),
    "true readout within two": of_cases(readout_within(2.0), False),
    "zoom found where there is none": of_cases(zoom_found_without, True),
    "zoom found": of_cases(zoom_found, False),
    "zoom: path off by more than 5 %, and no frame uncertain": of_cases(zoom_overlooked, True),
    "map wrong": of_cases(map_wrong, True),
    "right map: called not right by the check": of_cases(right_called_wrong, True),
    "right map: some frames called uncertain by the check": of_cases(right_doubted, True),
    "right map: frames that are uncertain": uncertain_frames,
    "wrong map: called not right by the check": of_cases(wrong_called_wrong, False),
    "map bent by 2 % of its extent and more: called not right": bent_found(RIGHT),
    "map bent by 2 % of its extent and more: keyframes of the wrong half uncertain": bent_keyframes,
    "map bent by 1 to 2 % of its extent: called not right": bent_found(0.01, RIGHT),
    "final ATE worse than online by more than 5 %": of_cases(ended_worse, True),
    "final ATE worse than online by more than 5 %, of maps that are not right": of_cases(
        ended_worse_not_right, True
    ),
}
"""What is counted. The rows of `of_cases` with False, and those of bent maps, should be high, the others low."""


def columns_of(cases: Sequence[Columns]) -> dict[str, list[Columns]]:
    """The cases by column of the table: kind and half."""
    return {
        f"{kind}, {half}": [case for case in cases if (case["kind"], case["half"]) == (kind, half)]
        for kind in KINDS
        for half in HALVES
    }


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--label", help="of the results; default: the commit")
    parser.add_argument("--names", action="store_true", help="print the names of the cases that are errors")
    options = parser.parse_args()
    path = file_of(options.label or commit())
    found = records(path)
    errors = [case["name"] for case in found if "error" in case]
    if errors:
        raise SystemExit(f"{path}: these cases raised an exception: {' '.join(errors)}")
    columns = columns_of(found)
    counted = {title: [count(cases) for cases in columns.values()] for title, count in ROWS.items()}
    header = ["decision", *columns]
    rows = [["cases", *(str(len(cases)) for cases in columns.values())]]
    rows += [[title, *(each.cell() for each in some)] for title, some in counted.items()]
    print(text := table(header, rows))
    if options.names:
        for title, some in counted.items():
            print(f"{title}: {', '.join(name for each in some for name in each.names) or 'none'}")
    print(costs(found))
    if not options.no_readme:
        write_between(Path(__file__).parent / "README.md", text)


def costs(cases: Sequence[Columns]) -> str:
    """Mean processor seconds per case."""
    lines = []
    for kind in KINDS:
        some = [case["seconds"] for case in cases if case["kind"] == kind]
        if some:
            means = {key: sum(each[key] for each in some) / len(some) for key in some[0]}
            lines.append(
                f"{kind}: {sum(means.values()):.1f} CPU s per case: "
                + ", ".join(f"{key} {value:.1f}" for key, value in means.items())
            )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
