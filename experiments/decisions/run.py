"""Run the cases and append what was decided in each to a file. See README.md.

A case that is in the file already is skipped; one that raised an exception is tried again.
"""

from __future__ import annotations

import itertools
import json
import multiprocessing
import subprocess
import traceback
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from experiments.common import parser_of
from experiments.decisions.cases import Case, add_choice, chosen, name_of
from experiments.decisions.measure import measured
from torchslam.batch import Columns

RESULTS = Path("results") / "decisions"


def commit() -> str:
    """The commit that is checked out, with `-edited` where tracked files differ from it."""
    described = subprocess.run(
        ["git", "describe", "--always", "--abbrev=8", "--exclude=*", "--dirty=-edited"],
        cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return described.stdout.strip()


def file_of(label: str) -> Path:
    """The results under a label."""
    return RESULTS / f"{label}.jsonl"


def records(path: Path) -> list[Columns]:
    """The results in a file, by case; the last one of each case, errors included. Empty without a file."""
    if not path.exists():
        return []
    lines = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    return list({columns["name"]: columns for columns in lines}.values())


def groups(cases: Iterable[Case]) -> Iterator[list[Case]]:
    """The cases in groups that share a scene, in the order of their first cases."""
    cases = list(cases)
    order = {group: place for place, group in enumerate(dict.fromkeys(case.group for case in cases))}
    ordered = sorted(cases, key=lambda case: order[case.group])
    for _, some in itertools.groupby(ordered, key=lambda case: case.group):
        yield list(some)


def run_group(cases: list[Case], path: Path) -> list[str]:
    """Run some cases; append a line for each. Returns messages of those that raised an exception."""
    failures = []
    for case in cases:
        try:
            columns = measured(case)
        except Exception as error:
            columns = {"name": name_of(case), "kind": case.kind, "error": traceback.format_exc()}
            failures.append(f"{name_of(case)}: {type(error).__name__}: {error}")
        with path.open("ab", buffering=0) as file:  # one write, so that processes do not mix their lines
            file.write((json.dumps(columns) + "\n").encode())
    return failures


def main() -> None:
    parser = parser_of(__doc__)
    add_choice(parser)
    parser.add_argument("--processes", type=int, default=1, metavar="N", help="each of one thread")
    parser.add_argument("--label", help="of the results; default: the commit")
    options = parser.parse_args()
    path = file_of(options.label or commit())
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {columns["name"] for columns in records(path) if "error" not in columns}
    cases = [case for case in chosen(options) if name_of(case) not in done]
    print(f"{path}: {len(cases)} cases to run", flush=True)
    failures: list[str] = []
    with ProcessPoolExecutor(options.processes, multiprocessing.get_context("spawn")) as pool:
        started = {pool.submit(run_group, some, path): some for some in groups(cases)}
        for finished in as_completed(started):
            failures += finished.result()
            print(*(name_of(case) for case in started[finished]), "done", flush=True)
    if failures:
        raise SystemExit("\n".join(failures))


if __name__ == "__main__":
    main()
