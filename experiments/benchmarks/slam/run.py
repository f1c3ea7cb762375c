"""How fast and accurate is the whole system compared with ORB-SLAM3 on the same machine? See README.md."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from experiments.benchmarks.problems import PEERS
from experiments.common import DATA_DIR, parser_of, run_command, table, write_between
from torchslam.data import open_sequence
from torchslam.data.trajectories import read_trajectory
from torchslam.errors import TrajectoryError
from torchslam.evaluation import evaluate

OURS, ALONE, PEER = "ours", "ours, one process", "ORB-SLAM3"
HEADER = ["sequence", "system", "ms, median", "ms, 95 %", "frames/s", "CPU ms a frame", "ATE, m", "posed"]


@dataclass(frozen=True)
class Recording:
    """The first frames of a sequence at the rate of its camera; `features` for ORB-SLAM3."""

    name: str
    frames: int
    rate: float
    features: int = 1000


RECORDINGS = (
    Recording("redkitchen", 300, 30),
    Recording("kitti07", 160, 10, features=2000),
    Recording("machine_hall", 160, 20),
    Recording("shelf_bin", 50, 15),
    Recording("fr2_desk_20", 20, 10),
)


@dataclass(frozen=True)
class Metrics:
    """Metrics of one run: times per frame, frames/s, CPU time of all processes per frame; ATE, if there is a path."""

    frames: int
    median: float
    p95: float
    rate: float
    cpu: float
    ate: float | None
    posed: int


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("names", nargs="*", default=[recording.name for recording in RECORDINGS])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--busy", type=int, default=0, help="other processes that compute meanwhile; the table is not written"
    )
    arguments = parser.parse_args()
    peer = find_peer()
    with busy_processes(arguments.busy):
        rows = measured_rows(arguments.names, arguments.rounds, peer)
    text = table(HEADER, rows)
    print(text)
    if not arguments.no_readme and not arguments.busy:
        write_between(Path(__file__).parent / "README.md", text)


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Processes that compute, each on its own, as a browser or a compiler beside would."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def measured_rows(names: list[str], rounds: int, peer: list[str] | None) -> list[list[str]]:
    """The rows of the table: medians of the rounds, in which the systems take turns."""
    rows = []
    for recording in RECORDINGS:
        if recording.name not in names:
            continue
        if not (DATA_DIR / recording.name).is_dir():
            print(f"{recording.name}: not in {DATA_DIR}, skipped")
            continue
        runs: dict[str, list[Metrics]] = {}
        for _ in range(rounds):
            for system in systems(peer is not None):
                runs.setdefault(system, []).append(measured(system, recording, peer))
                print(recording.name, system, runs[system][-1], flush=True)
        rows += [row(recording, system, figures) for system, figures in runs.items()]
    return rows


def systems(with_peer: bool) -> list[str]:
    """The systems that run a recording."""
    ours = [OURS, ALONE]
    return [*ours, PEER] if with_peer else ours


def find_peer() -> list[str] | None:
    """The command of ORB-SLAM3: the interpreter in ORB_SLAM3_PYTHON with the script next to the data."""
    python, script = os.environ.get("ORB_SLAM3_PYTHON"), PEERS / "run_orbslam.py"
    if not script.is_file():
        script = DATA_DIR.parent / "peers" / "run_orbslam.py"
    if python is None or not script.is_file():
        print(f"ORB-SLAM3: skipped; set ORB_SLAM3_PYTHON to the interpreter that has it, for {script}")
        return None
    return [python, str(script)]


def measured(system: str, recording: Recording, peer: list[str] | None) -> Metrics:
    """One run of a system, with the CPU time of all its processes."""
    source = DATA_DIR / recording.name
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if system == PEER:
            line = [*(peer or []), str(source), str(folder), "--realtime", "--count", str(recording.frames)]
            line += ["--fps", str(recording.rate), "--features", str(recording.features)]
        else:
            line = [sys.executable, "-m", "experiments.benchmarks.slam.ours", str(source)]
            line += [str(folder / "trajectory.txt"), "--limit", str(recording.frames)]
            line += ["--processes", "1"] if system == ALONE else []
        printed, seconds = with_cpu_time(line)
        figures = json.loads(printed.strip().split("\n")[-1])
        ate, posed = accuracy(folder / "trajectory.txt", source, recording.frames)
    frames = figures["frames"]
    if system == PEER:
        rate, start_up = 1e3 / figures["ms_mean"], figures["vocab_load_s"]
    else:
        rate, start_up = figures["frames_per_s"], figures["start_up_s"]
    cpu = 1e3 * (seconds - start_up) / frames
    return Metrics(frames, figures["ms_median"], figures["ms_p95"], rate, cpu, ate, posed)


def with_cpu_time(line: list[str]) -> tuple[str, float]:
    """Run a command; return its output and the processor seconds of it and its children."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryFile("w+") as printed:
        status, used = run_command(line, printed, environment=environment)
        if status:
            raise SystemExit(f"{' '.join(line)}: ended with {status}")
        printed.seek(0)
        return printed.read(), used.cpu_s


def accuracy(path: Path, source: Path, frames: int) -> tuple[float | None, int]:
    """ATE in meters, if it can be computed, and the number of poses."""
    truth = open_sequence(source, limit=frames).groundtruth
    try:
        trajectory = read_trajectory(path)
        return None if truth is None else evaluate(trajectory, truth).ate_m, len(trajectory)
    except TrajectoryError:  # no poses, or too few
        return None, 0


def row(recording: Recording, system: str, runs: list[Metrics]) -> list[str]:
    """The medians of some runs."""
    ates = [run.ate for run in runs if run.ate is not None]
    return [
        f"{recording.name}, {recording.frames}",
        system,
        f"{statistics.median(run.median for run in runs):.1f}",
        f"{statistics.median(run.p95 for run in runs):.0f}",
        f"{statistics.median(run.rate for run in runs):.1f}",
        f"{statistics.median(run.cpu for run in runs):.0f}",
        f"{statistics.median(ates):.4f}" if ates else "",
        f"{statistics.median_low(run.posed for run in runs)} of {runs[0].frames}",
    ]


if __name__ == "__main__":
    main()
