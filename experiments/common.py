"""Shared by the experiments: sequences, batches of runs with their metrics, cached results, Markdown tables."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

import experiments.storey  # noqa: F401  it adds a scene
from torchslam.batch import ERROR, Columns, Engine, Row, Task, run_batch
from torchslam.batch.engines import ENGINES
from torchslam.batch.result_store import RUNS, hash_files, program_hash, run_or_reuse
from torchslam.batch.results_table import read_times
from torchslam.batch.rows import short_name
from torchslam.data import Sequence as Frames
from torchslam.data import open_sequence
from torchslam.geometry import se3_inverse
from torchslam.io.results import read_metrics
from torchslam.system.run import Run
from torchslam.types import Trajectory
from torchslam.utils.files import fingerprint

T = TypeVar("T")
DATA_DIR = Path(os.environ.get("TORCHSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))


DRONE_CAMERA, DRONE_TRUTH = "553,553,319.5,179.5", "drone_colmap.txt"
"""Of drone.mp4, which comes without: as COLMAP found them."""


def place_of(name: str) -> str:
    """The argument of `open_sequence` for a rendered sequence or one in `DATA_DIR`."""
    return name if name.startswith("synthetic:") else str(DATA_DIR / name)


def sequences(names: Iterable[str]) -> list[Frames]:
    """Open the available sequences; report the others."""
    return [open_sequence(place_of(name)) for name in available(names)]


def available(names: Iterable[str]) -> list[str]:
    """Select rendered sequences and those in `DATA_DIR`; report the others."""
    found = []
    for name in names:
        if name.startswith("synthetic:") or (DATA_DIR / name).exists():
            found.append(name)
        else:
            print(f"{name}: not at {DATA_DIR}, left out")
    return found


def row_of(name: str, *labels: str, overrides: Iterable[str] = (), **more: Any) -> Row:
    """A row of a batch; `labels` distinguish it from other runs over the same sequence."""
    label = "_".join(short_name(word) for word in (name.removeprefix("synthetic:"), *labels))
    return Row(label, place_of(name), overrides=tuple(overrides), **more)


class Backward(Frames):
    """The frames of a sequence in reverse."""

    def __init__(self, forward: Frames) -> None:
        times = (forward.timestamps[-1] - forward.timestamps).flip(0)
        truth = forward.groundtruth
        if truth is not None:
            truth = Trajectory((forward.timestamps[-1] - truth.timestamps).flip(0), truth.T_wc.flip(0))
        super().__init__(forward.name, forward.kind, forward.camera, times, truth)
        self._forward = forward

    def image(self, index: int) -> Tensor:
        return self._forward.image(len(self) - 1 - index)

    def image_name(self, index: int) -> str:
        return self._forward.image_name(len(self) - 1 - index)


def scaled(T_cw: Float[Tensor, "K 4 4"], factor: float, about: int | None = None) -> Float[Tensor, "K 4 4"]:
    """Scale the second half of the poses around a camera; None: around its first one."""
    T_wc, half = se3_inverse(T_cw), len(T_cw) // 2
    center = T_wc[half if about is None else about, :3, 3].clone()
    T_wc[half:, :3, 3] = center + factor * (T_wc[half:, :3, 3] - center)
    return se3_inverse(T_wc)


def focal_of(run: Run) -> str:
    """The focal length that the final adjustment found, with its standard error; without one the given one."""
    found = run.calibration
    if found is None:
        return f"{float(run.camera.focal):.1f}"
    return f"{float(found.camera.focal):.1f} ± {float(found.camera.focal) * found.focal_std:.1f}"


def parser_of(
    description: str | None, output: Path | None = None, readme: bool = False
) -> argparse.ArgumentParser:
    """Create the parser of an experiment.

    description: of its module; output: default of the file for its table; readme: whether it writes into a README
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if output is not None:
        parser.add_argument("--output", type=Path, default=output)
    if readme:
        parser.add_argument("--no-readme", action="store_true", help="print only")
    return parser


def add_engine(parser: argparse.ArgumentParser, experiment: str) -> None:
    """Add the options for the output folder and the engine of an experiment; existing results are reused."""
    parser.add_argument("--output", type=Path, default=Path("results") / experiment, metavar="DIR")
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    parser.add_argument("--workers", type=int, metavar="N", help="of --engine ray")


def metrics_of_runs(rows: Sequence[Row], options: argparse.Namespace, plots: bool = False) -> list[Columns]:
    """Run the rows with the options of `add_engine`; return the metrics of each, times included.

    Raises SystemExit if one ended with an error.
    """
    output = options.output.absolute()
    tasks = [Task(row, str(output), overwrite=True, plots=plots) for row in rows]
    check(run_batch(tasks, Engine(options.engine, options.workers), on_progress=_log))
    folders = [output / RUNS / row.name for row in rows]
    return [read_metrics(folder) | read_times(folder) for folder in folders]


def publish(text: str, options: argparse.Namespace, module: str, *marks: str) -> None:
    """Print the result of an experiment, and write it into the README next to its module without --no-readme.

    marks: start and end of the text in the README, if they are not those of `write_between`
    """
    print(text)
    if not options.no_readme:
        write_between(Path(module).parent / "README.md", text, *marks)


def publish_page(title: str, text: str, options: argparse.Namespace) -> None:
    """Print the result of a benchmark, and write it as a page into the file --output."""
    print(text)
    options.output.write_text(f"# {title}\n\n{text}", encoding="utf-8")


def cached_run(
    name: str, label: str, settings: Iterable[str], work: Callable[[Path], Columns], output: str, code: Path
) -> Columns:
    """Run a part of an experiment that is not a row of a batch, or reuse its stored columns: see `run_or_reuse`.

    name: unique, part of a folder name; label: its name in the experiment
    code: folder of the experiment, hashed together with torchslam and the data
    """

    def fingerprints_of() -> Columns:
        config = fingerprint([label, list(settings), program_hash()])
        return {"configuration": config, "input": hash_files([f"{code}/*.py", str(DATA_DIR)])}

    return run_or_reuse(Path(output), name, fingerprints_of, work, overwrite=True)


def run_cases(
    work: Callable[[Columns], Columns],
    cases: Sequence[Columns],
    options: argparse.Namespace,
    on_progress: Callable[[Columns], None],
) -> list[Columns]:
    """Apply a function that never raises, such as `cached_run`, to each case; cases are JSON values.

    Raises SystemExit if a process died.
    """
    found: dict[int, Columns] = {}
    for number, columns in Engine(options.engine, options.workers).map_unordered(work, cases):
        if columns is None:
            raise SystemExit(f"{cases[number]}: its process died")
        found[number] = columns
        on_progress(columns)
    return [found[number] for number in range(len(cases))]


def check(found: Iterable[Columns]) -> None:
    """Raise SystemExit with the runs that ended with an error."""
    errors = [f"{columns['name']}: {columns['error']}" for columns in found if columns["status"] == ERROR]
    if errors:
        raise SystemExit("\n".join(errors))


def _log(columns: Columns) -> None:
    print(columns["name"], columns["status"], columns.get("ate_m", ""), sep="\t", file=sys.stderr, flush=True)


# Linux counts the memory of the process that starts a command as the command's own, so a small process starts it.
_LAUNCHER = """
import json, os, sys
process = os.spawnvp(os.P_NOWAIT, sys.argv[2], sys.argv[2:])
_, status, used = os.wait4(process, 0)
with open(sys.argv[1], "w") as file:
    json.dump([os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss], file)
"""


@dataclass(frozen=True)
class Usage:
    """What a command and its children used: processor and elapsed seconds, and the memory of the largest process."""

    cpu_s: float
    wall_s: float
    peak_mb: float


def run_command(
    line: Sequence[str],
    stdout: IO[str],
    stderr: IO[str] | None = None,
    environment: Mapping[str, str] | None = None,
) -> tuple[int, Usage]:
    """Run a command to its end; return its exit status and what it used."""
    with tempfile.NamedTemporaryFile("r") as found:
        launcher = [sys.executable, "-I", "-S", "-c", _LAUNCHER, found.name, *line]
        start = time.perf_counter()
        subprocess.run(launcher, stdout=stdout, stderr=stderr, env=environment, check=True)
        wall_s = time.perf_counter() - start
        status, cpu_s, peak_kb = json.load(found)
    return status, Usage(cpu_s, wall_s, peak_kb / 1024)


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """Call a function; return its result and the processor time in ms."""
    start = time.process_time()
    result = call()
    return result, 1e3 * (time.process_time() - start)


def milliseconds(*tasks: Callable[[], Any], repeats: int = 15) -> list[float]:
    """Median processor time of each task, taken in turns so that a busy machine slows all of them alike.

    A task may return a float: the milliseconds that count. Two more rounds before the others are not counted.
    """
    times: list[list[float]] = [[] for _ in tasks]
    for _ in range(repeats + 2):
        for task, record in zip(tasks, times, strict=True):
            result, spent = timed(task)
            record.append(result if isinstance(result, float) else spent)
    return [statistics.median(record[2:]) for record in times]


def gradient_error(
    solve: Callable[..., Tensor],
    inputs: Mapping[str, Tensor],
    steps: Mapping[str, float],
    reference: Callable[..., Tensor] | None = None,
) -> float:
    """Largest relative error of gradients against central differences, along one random direction for each input.

    solve: from the inputs to a number; steps: of the differences, for each input with a gradient
    reference: what is differenced, where it is not `solve`
    """
    reference = reference or solve
    generator = torch.Generator().manual_seed(0)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}
    gradients = torch.autograd.grad(solve(**leaves), [leaves[name] for name in steps])
    worst = 0.0
    for (name, step), gradient in zip(steps.items(), gradients, strict=True):
        direction = torch.randn(inputs[name].shape, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            ahead, behind = (
                reference(**{**inputs, name: inputs[name] + sign * step * direction}) for sign in (1, -1)
            )
        expected = (ahead - behind) / (2 * step)
        worst = max(worst, float(((gradient * direction).sum() / expected - 1).abs()))
    return worst


def table(header: str | Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a Markdown table; header: the titles of the columns, in one string separated by " | "."""
    titles = header.split(" | ") if isinstance(header, str) else header
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def write_between(
    readme: Path, text: str, start: str = "<!-- table -->\n", end: str = "<!-- end -->"
) -> None:
    """Replace the text between two marks of a README."""
    before, _, rest = readme.read_text(encoding="utf-8").partition(start)
    _, _, after = rest.partition(end)
    readme.write_text(f"{before}{start}{text}{end}{after}", encoding="utf-8")
