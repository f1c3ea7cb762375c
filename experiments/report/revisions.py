"""Compare two revisions on the benchmark sequences: posed frames, ATE, processor time and the trajectory's bytes.

    python -m experiments.report.revisions v0.1.0 HEAD
    python -m experiments.report.revisions HEAD . shelf_bin kitti07 --rounds 3     # "." is the working tree

Both revisions run in turn on this machine, one process and one thread each, with their default configuration. Times are
processor times: a frame's share of the run, the median and the 95th percentile of `SLAM.step`; medians of the rounds.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from experiments.benchmarks.slam.run import RECORDINGS, Recording
from experiments.common import DATA_DIR, parser_of, table
from experiments.report.record import ROOT

WORKING_TREE = "."
# Only calls that every revision has.
MEASURE = """
import hashlib, json, sys, time, torch
torch.set_num_threads(1)
from torchslam import SLAM, Config, evaluate, open_sequence
sequence = open_sequence(sys.argv[1], limit=int(sys.argv[2]))
step, steps = SLAM.step, []
def timed_step(slam, frame):
    start = time.process_time()
    result = step(slam, frame)
    steps.append(1e3 * (time.process_time() - start))
    return result
SLAM.step = timed_step
start = time.process_time()
run = SLAM(sequence.camera, Config()).run(sequence)
spent = 1e3 * (time.process_time() - start) / len(sequence)
poses = run.trajectory
truth = sequence.groundtruth
ate = None if truth is None or len(poses) < 3 else evaluate(poses, truth).ate_m
digest = hashlib.sha256(poses.T_wc.numpy().tobytes()).hexdigest()
steps.sort()
print(json.dumps({"posed": len(poses), "frames": len(sequence), "ate": ate, "ms": spent, "digest": digest,
    "median": steps[len(steps) // 2], "p95": steps[int(0.95 * len(steps))]}))
"""


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("before", metavar="REV_A", help="a git revision, or . for the working tree")
    parser.add_argument("after", metavar="REV_B", help="likewise")
    parser.add_argument("names", nargs="*", default=[recording.name for recording in RECORDINGS])
    parser.add_argument("--rounds", type=int, default=3, help="runs of each; times are medians")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        sources = [
            source_of(revision, Path(folder) / side)
            for side, revision in (("a", arguments.before), ("b", arguments.after))
        ]
        for recording in RECORDINGS:
            if recording.name in arguments.names:
                pairs = [[measure(recording, source) for source in sources] for _ in range(arguments.rounds)]
                rows.append(
                    compared(recording.name, [pair[0] for pair in pairs], [pair[1] for pair in pairs])
                )
                print(*rows[-1], sep="\t", flush=True)
    header = (
        "sequence | posed A, B | ATE A, m | ATE B, m | B / A | ms a frame B | B / A | median | 95 % | poses"
    )
    print("\n" + table(header, rows))


def source_of(revision: str, folder: Path) -> Path:
    """The folder with a revision's files, unpacked without touching the checkout."""
    if revision == WORKING_TREE:
        return ROOT
    folder.mkdir()
    archive = subprocess.run(
        ["git", "archive", revision, "torchslam", "configs"], cwd=ROOT, capture_output=True
    )
    if archive.returncode:
        raise SystemExit(f"{revision}: {archive.stderr.decode().strip()}")
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    return folder


def measure(recording: Recording, source: Path) -> dict[str, Any]:
    """One run of the code in a folder over a recording."""
    environment = os.environ | {"PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-c", MEASURE, str(DATA_DIR / recording.name), str(recording.frames)]
    done = subprocess.run(line, env=environment, cwd=source, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def compared(name: str, before: list[dict[str, Any]], after: list[dict[str, Any]]) -> list[str]:
    """A row of the table from the rounds of both revisions; poses are those of the first round."""
    a, b = before[0], after[0]
    ratios = []
    for figure in ("ms", "median", "p95"):
        times = [statistics.median(run[figure] for run in runs) for runs in (before, after)]
        ratios.append(times[1] / times[0])
    ates = [run["ate"] for run in (a, b)]
    has_ate = None not in ates
    return [
        name,
        f"{a['posed']}, {b['posed']} of {b['frames']}",
        *("" if ate is None else f"{ate:.4f}" for ate in ates),
        f"{ates[1] / ates[0]:.2f}" if has_ate else "",
        f"{statistics.median(run['ms'] for run in after):.0f}",
        *(f"{ratio:.3f}" for ratio in ratios),
        "same bytes" if a["digest"] == b["digest"] else "different",
    ]


if __name__ == "__main__":
    main()
