"""What the experiments share: where sequences lie, batches of runs with their figures, Markdown tables."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from torchslam.batch import ENGINES, ERROR, Columns, Engine, Row, Task, run_batch
from torchslam.batch.result_store import RUNS, hash_files, hash_json, program_hash, run_or_reuse
from torchslam.batch.rows import short_name
from torchslam.batch.table import read_times
from torchslam.data import Sequence as Frames
from torchslam.data import open_sequence
from torchslam.io.results import read_metrics

DATA_DIR = Path(os.environ.get("TORCHSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))


def sequences(names: list[str]) -> list[Frames]:
    """Open those of the sequences that are at hand; say which are not."""
    found = []
    for name in names:
        if name.startswith("synthetic:"):
            found.append(open_sequence(name))
        elif (DATA_DIR / name).is_dir():
            found.append(open_sequence(DATA_DIR / name))
        else:
            print(f"{name}: not at {DATA_DIR}, left out")
    return found


def at_hand(names: Iterable[str]) -> list[str]:
    """Those of the names that are rendered sequences, or folders and files of `DATA_DIR`; says which are not."""
    found = []
    for name in names:
        if name.startswith("synthetic:") or (DATA_DIR / name).exists():
            found.append(name)
        else:
            print(f"{name}: not at {DATA_DIR}, left out")
    return found


def row_of(name: str, *apart: str, overrides: Iterable[str] = (), **more: Any) -> Row:
    """A row of a batch: a sequence that is `at_hand`; `apart`: words that tell it from other runs over the same."""
    place = name if name.startswith("synthetic:") else str(DATA_DIR / name)
    label = "_".join(short_name(word) for word in (name.removeprefix("synthetic:"), *apart))
    return Row(label, place, overrides=tuple(overrides), **more)


def parser_of(description: str | None, output: Path | None = None) -> argparse.ArgumentParser:
    """A parser of an experiment that its module describes, with the file that its table goes to, if it has one."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if output is not None:
        parser.add_argument("--output", type=Path, default=output)
    return parser


def add_engine(parser: argparse.ArgumentParser, experiment: str) -> None:
    """Where the runs of an experiment go, and who does them; what is there already is not done again."""
    parser.add_argument("--output", type=Path, default=Path("results") / experiment, metavar="DIR")
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    parser.add_argument("--workers", type=int, metavar="N", help="of --engine ray")


def figures_of_all(rows: Sequence[Row], options: argparse.Namespace, pictures: bool = False) -> list[Columns]:
    """Run the rows with the options of `add_engine`; returns the metrics of each, times included.

    Raises SystemExit where one ended with an error.
    """
    output = options.output.absolute()
    tasks = [Task(row, str(output), overwrite=True, pictures=pictures) for row in rows]
    check(run_batch(tasks, Engine(options.engine, options.workers), on_progress=_tell))
    folders = [output / RUNS / row.name for row in rows]
    return [read_metrics(folder) | read_times(folder) for folder in folders]


def kept(
    name: str, label: str, settings: Iterable[str], work: Callable[[Path], Columns], output: str, code: Path
) -> Columns:
    """Run a piece of an experiment that is not a row of a batch, or reuse its stored columns: see `run_or_reuse`.

    name:  unique, as a part of the name of a folder; label: what it is called in the experiment
    work:  as of `run_or_reuse`; code: folder of the experiment, hashed together with torchslam and the data
    """

    def fingerprints_of() -> Columns:
        config = hash_json({"label": label, "settings": list(settings), "program": program_hash()})
        return {"configuration": config, "input": hash_files([f"{code}/*.py", str(DATA_DIR)])}

    return run_or_reuse(Path(output), name, fingerprints_of, work, overwrite=True)


def each_case(
    work: Callable[[Columns], Columns],
    cases: Sequence[Columns],
    options: argparse.Namespace,
    on_progress: Callable[[Columns], None],
) -> list[Columns]:
    """What a function that never raises, as by `kept`, makes of the cases; `on_progress` each of them when it is done.

    Cases are what JSON can say. Raises SystemExit where a process died.
    """
    found: dict[int, Columns] = {}
    for number, columns in Engine(options.engine, options.workers).each(work, cases):
        if columns is None:
            raise SystemExit(f"{cases[number]}: the process that ran it died")
        found[number] = columns
        on_progress(columns)
    return [found[number] for number in range(len(cases))]


def check(found: Iterable[Columns]) -> None:
    """Raises SystemExit that names what ended with an error."""
    errors = [f"{columns['name']}: {columns['error']}" for columns in found if columns["status"] == ERROR]
    if errors:
        raise SystemExit("\n".join(errors))


def _tell(columns: Columns) -> None:
    print(columns["name"], columns["status"], columns.get("ate_m", ""), sep="\t", file=sys.stderr, flush=True)


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def write_between(readme: Path, text: str) -> None:
    """Replace what stands between the two marks `<!-- table -->` and `<!-- end -->` of a README."""
    before, _, rest = readme.read_text(encoding="utf-8").partition("<!-- table -->\n")
    _, _, after = rest.partition("<!-- end -->")
    readme.write_text(f"{before}<!-- table -->\n{text}<!-- end -->{after}", encoding="utf-8")
