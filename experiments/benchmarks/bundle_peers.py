"""A small and a large bundle adjustment by every differentiable solver that installs, and by Ceres.

    apt-get install libsuitesparse-dev                                           # for CHOLMOD
    python -m venv --system-site-packages peers                                  # beside torchslam's own packages
    peers/bin/pip install pycolmap pypose almond-jaxls jaxlie 'setuptools<81' wheel cython
    peers/bin/pip install --no-build-isolation 'scikit-sparse<0.5' theseus-ai
    peers/bin/python -m experiments.benchmarks.bundle_peers [--output FILE]

Each solver runs in a process of its own, on one core, with an end to its time and memory. Prints tables, writes them to
FILE. With --peer and --problem: one solver alone, in this process; its result as a line of JSON.
"""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from experiments.benchmarks import bundle_formulations
from experiments.benchmarks.bundle import FRAMES, POINTS, ring, window
from experiments.benchmarks.bundle_formulations import Stated
from experiments.benchmarks.solvers import rmse
from experiments.common import parser_of, table
from torchslam.optim import BundleProblem

HERE = Path(__file__).parent
SECONDS, GIGABYTES = 200, 8  # of processor time and memory that a solver is given
REPEATS, LONG_MS = (
    5,
    2e4,
)  # solves after the first, of which the median counts; one where it takes as long as this

# Name of the formulation: how the table calls it.
PEERS = {
    "torchslam": "torchslam",
    "ceres": "Ceres (COLMAP's)",
    "jaxls": "jaxls, CHOLMOD",
    "jaxls_iterative": "jaxls, conjugate gradients",
    "theseus": "theseus, CHOLMOD",
    "theseus_dense": "theseus, dense",
    "pypose": "pypose",
    "pypose_rows": "pypose, `vectorize=False`",
    "pypose_sparse": "pypose, `sparse=True`",
}
PARTS = (5,)  # cameras of the large problem that those are given who can not hold all


def seen_twice(problem: BundleProblem) -> BundleProblem:
    """Without the points that the peers can not determine."""
    counts = torch.bincount(problem.point_index, minlength=len(problem.points_w))
    rows = counts[problem.point_index] >= 2
    kept, point_index = torch.unique(problem.point_index[rows], return_inverse=True)
    return replace(
        problem,
        points_w=problem.points_w[kept],
        frame_index=problem.frame_index[rows],
        point_index=point_index,
        pixels=problem.pixels[rows],
    )


def first_frames(problem: BundleProblem, frames: int) -> BundleProblem:
    rows = problem.frame_index < frames
    part = replace(
        problem,
        T_cw=problem.T_cw[:frames],
        frame_index=problem.frame_index[rows],
        point_index=problem.point_index[rows],
        pixels=problem.pixels[rows],
    )
    return seen_twice(part)


def problem_of(name: str) -> BundleProblem:
    """ "window", "ring", or "ring10": what the first ten cameras of the ring see."""
    if name == "window":
        return seen_twice(window(0))
    frames = name.removeprefix("ring")
    return first_frames(ring(), int(frames)) if frames else ring()


def timed(task: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.process_time()
    done = task()
    return done, 1e3 * (time.process_time() - begin)


def gradient_of(stated: Stated, problem: BundleProblem, solve_ms: float) -> dict[str, Any]:
    """What the gradient costs more than the solve alone, and how far it is from ours; or why there is none."""
    if stated.gradient is None:
        return {"refused": "none"}
    exact = bundle_formulations.torchslam(problem).gradient
    assert exact is not None
    try:
        gradient, first_ms = timed(stated.gradient)
    except ValueError as error:  # how jax refuses reverse mode
        return {"refused": str(error).split(". ")[0].splitlines()[0]}
    times = [timed(stated.gradient)[1] for _ in range(REPEATS)] if first_ms < LONG_MS else [first_ms]
    off = float((gradient - exact()).norm() / exact().norm())
    return {"gradient_ms": statistics.median(times) - solve_ms, "off": off}


def alone(peer: str, problem_name: str) -> dict[str, Any]:
    """The result of one solver, found in this process, on one core."""
    warnings.simplefilter("ignore")
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    resource.setrlimit(resource.RLIMIT_DATA, (GIGABYTES << 30, GIGABYTES << 30))
    problem = problem_of(problem_name)
    stated, state_ms = timed(lambda: getattr(bundle_formulations, peer)(problem))
    found, first_ms = timed(stated.solve)
    times = []
    for _ in range(REPEATS if first_ms < LONG_MS else 0):
        found, elapsed = timed(stated.solve)
        times.append(found.solve_ms or elapsed)
    solve_ms = statistics.median(times) if times else found.solve_ms or first_ms
    result = {
        "rmse_px": rmse(replace(problem, T_cw=found.T_cw, points_w=found.points_w)),
        "before_ms": state_ms + first_ms - solve_ms,
        "solve_ms": solve_ms,
        "iterations": found.iterations,
        "solve_mb": memory_mb(),
    }
    return result | gradient_of(stated, problem, solve_ms) | {"memory_mb": memory_mb()}


def memory_mb() -> float:
    """The most memory that this process had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run(peer: str, problem: str) -> dict[str, Any]:
    """The result of one solver in a process of its own; `failed` says what ended it."""
    command = [
        sys.executable,
        "-m",
        "experiments.benchmarks.bundle_peers",
        "--peer",
        peer,
        "--problem",
        problem,
    ]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode == 0:
        result: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
        return result
    if ended.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return {"failed": f"more than {SECONDS} s"}
    raised = [line for line in ended.stderr.splitlines() if re.match(r"[\w.]+(Error|Exception)\b", line)]
    last = raised[-1] if raised else f"exit status {ended.returncode}"
    short_of_memory = any(word in ended.stderr for word in ("allocate memory", "MemoryError", "bad_alloc"))
    return {"failed": f"more than {GIGABYTES} GB" if short_of_memory else last}


def rows_of(problem: str, peers: Sequence[str]) -> list[list[str]]:
    rows = []
    for peer in peers:
        found = run(peer, problem)
        print(problem, peer, found, file=sys.stderr, flush=True)
        if "failed" in found:
            rows.append([PEERS[peer], *6 * [""], found["failed"]])
            continue
        each = found["solve_ms"] / found["iterations"]
        gradient = found.get("refused") or f"{found['gradient_ms']:.0f} ms more"
        gradient += f", {found['off']:.0e} off" if found.get("off") else ""
        rows.append(
            [
                PEERS[peer],
                f"{found['rmse_px']:.4f}",
                f"{found['before_ms']:.0f}",
                f"{found['solve_ms']:.0f}",
                f"{found['iterations']}",
                f"{each:.1f}",
                f"{found['solve_mb']:.0f}, {found['memory_mb']:.0f}",
                gradient,
            ]
        )
    return rows


HEADER = [
    "",
    "RMSE, px",
    "once before, ms",
    "solve, ms",
    "iterations",
    "an iteration, ms",
    "memory of solve and gradient, MB",
    "gradient to all pixels",
]


def section(title: str, problem: str, peers: Sequence[str]) -> list[str]:
    return [f"## {title}", "", table(HEADER, rows_of(problem, peers)), ""]


def main() -> None:
    parser = parser_of(__doc__, HERE / "bundle_peers.md")
    parser.add_argument("--peer", choices=PEERS)
    parser.add_argument("--problem", default="ring")
    arguments = parser.parse_args()
    if arguments.peer:
        print(json.dumps(alone(arguments.peer, arguments.problem)))
        return
    dense = ["torchslam", "theseus_dense", "pypose"]
    lines = [
        "# Bundle adjustment beside the others",
        "",
        "Each in a process of its own, one core, float64. CPU time: the median of the solves after the first; what the "
        "first takes more (stating the problem, analysing, compiling) stands under *once before*. The gradient is that "
        "of a sum over all points; its time is what solving with it takes more than solving without, and *off* its "
        f"distance from ours, which central differences confirm ([bundle.md](bundle.md)). At most {SECONDS} s and "
        f"{GIGABYTES} GB each.",
        "",
        "    python -m experiments.benchmarks.bundle_peers",
        "",
        *section(f"One window of {FRAMES} frames and {POINTS} points", "window", list(PEERS)),
        *section("Theseus's issue 565: 100 cameras, 3500 points, 43,000 observations", "ring", list(PEERS)),
    ]
    for frames in PARTS:
        part = problem_of(f"ring{frames}")
        size = f"{len(part.points_w)} points, {len(part.pixels)} observations"
        lines += section(f"Its first {frames} cameras: {size}", f"ring{frames}", dense)
    text = "\n".join(lines)
    print(text)
    arguments.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
