"""One run of a sequence in its own process; prints its metrics as JSON for `run.py`.

python -m experiments.benchmarks.slam.ours SEQUENCE TRAJECTORY --processes 2 --limit 160
"""

from __future__ import annotations

import json
import resource
import time
from pathlib import Path

import torch

from experiments.common import parser_of
from torchslam.config import load_config
from torchslam.data import open_sequence
from torchslam.data.trajectories import write_trajectory
from torchslam.system.online_run import Observer, OnlineRun
from torchslam.system.slam import SLAM
from torchslam.types import StepResult


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("trajectory", type=Path)
    parser.add_argument("--processes", type=int)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--config", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    sequence = open_sequence(arguments.sequence, limit=arguments.limit)
    slam = SLAM(sequence.camera, load_config(arguments.config))
    ends: list[float] = []

    def after_frame(result: StepResult) -> None:
        ends.append(time.perf_counter())

    start_up, begin = cpu_seconds(), time.perf_counter()
    finished = OnlineRun(slam, sequence, None, arguments.processes, Observer(after_frame)).run()
    write_trajectory(arguments.trajectory, finished.trajectory)
    totals = torch.tensor([result.stage_ms["total"] for result in finished.results])
    figures = {
        "frames": len(finished.results) + len(finished.skipped),
        "ms_median": float(totals.median()),
        "ms_p95": float(totals.quantile(0.95)),
        "frames_per_s": len(ends) / (ends[-1] - begin),
        "start_up_s": start_up,
    }
    print(json.dumps(figures))


def cpu_seconds() -> float:
    """Processor seconds of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
