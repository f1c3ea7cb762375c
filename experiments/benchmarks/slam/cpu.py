"""Processor time a frame in one process, beside that of another checkout, in turn on the same machine.

git worktree add ../before d879422
python -m experiments.benchmarks.slam.cpu --beside ../before
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
from pathlib import Path

from experiments.benchmarks.slam.run import RECORDINGS, Recording
from experiments.common import DATA_DIR, table

HERE = Path(__file__).parents[3]
# Asks for nothing but what every checkout has.
MEASURE = """
import sys, time, torch
torch.set_num_threads(1)
from torchslam import SLAM, Config, open_sequence
sequence = open_sequence(sys.argv[1], limit=int(sys.argv[2]))
start = time.process_time()
SLAM(sequence.camera, Config()).run(sequence)
print(1e3 * (time.process_time() - start) / len(sequence))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[recording.name for recording in RECORDINGS])
    parser.add_argument("--beside", type=Path, required=True, help="folder of the other checkout")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    rows = []
    for recording in RECORDINGS:
        if recording.name not in arguments.names:
            continue
        times = [
            (measured(recording, arguments.beside), measured(recording, HERE))
            for _ in range(arguments.rounds)
        ]
        before, now = (statistics.median(some) for some in zip(*times, strict=True))
        rows.append([recording.name, f"{before:.0f}", f"{now:.0f}", f"{now / before:.2f}"])
        print(*rows[-1], flush=True)
    print(table(["sequence", "there, ms", "here, ms", "here / there"], rows))


def measured(recording: Recording, checkout: Path) -> float:
    """Milliseconds of processor time a frame of the code in a folder."""
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve()), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-c", MEASURE, str(DATA_DIR / recording.name), str(recording.frames)]
    told = subprocess.run(line, env=environment, cwd=checkout, stdout=subprocess.PIPE, text=True, check=True)
    return float(told.stdout)


if __name__ == "__main__":
    main()
