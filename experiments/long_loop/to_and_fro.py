"""Does the map of one room grow with the length of the run? See README.md."""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import DATA_DIR, parser_of, table, write_between
from torchslam.config import Config
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.evaluation import evaluate
from torchslam.geometry import se3_inverse
from torchslam.system.run import finish
from torchslam.system.slam import SLAM
from torchslam.types import StepResult, Trajectory

WINDOW = 500  # frames
START, END = "<!-- to and fro -->\n", "<!-- end of to and fro -->"


class ToAndFro(Sequence):
    """The frames of a sequence forwards, backwards, forwards, with timestamps that go on."""

    def __init__(self, whole: Sequence, frames: int) -> None:
        period = 2 * (len(whole) - 1)
        self._whole = whole
        self._order = [min(i % period, period - i % period) for i in range(frames)]
        timestamps = torch.arange(frames, dtype=torch.float64) / whole.frame_rate
        posed = [(i, pose) for i, j in enumerate(self._order) if (pose := whole.pose(j)) is not None]
        truth = Trajectory(
            timestamps[[i for i, _ in posed]], se3_inverse(torch.stack([pose for _, pose in posed]))
        )
        super().__init__(whole.name, whole.kind, whole.camera, timestamps, truth)

    def image(self, index: int) -> Tensor:
        return self._whole.image(self._order[index])

    def image_name(self, index: int) -> str:
        return self._whole.image_name(self._order[index])


def megabytes() -> int:
    """The most memory that the process has had."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak // (2**20 if sys.platform == "darwin" else 2**10)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--sequence", default=str(DATA_DIR / "redkitchen"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    sequence = ToAndFro(open_sequence(options.sequence), options.frames)
    slam = SLAM(sequence.camera, Config())
    ms: list[float] = []
    results: list[StepResult] = []
    rows: list[list[str]] = []
    for index in range(len(sequence)):
        frame, before = sequence[index], time.process_time()
        results.append(slam.step(frame))
        ms.append(1e3 * (time.process_time() - before))
        if index % WINDOW == WINDOW - 1:
            cost = torch.tensor(ms[-WINDOW:], dtype=torch.float64)
            rows.append(
                [
                    f"{index + 1 - WINDOW} to {index + 1}",
                    f"{cost.median():.1f}",
                    f"{cost.mean():.1f}",
                    str(slam.map.num_keyframes),
                    str(slam.map.num_points),
                    str(len(slam.map.points)),
                    str(megabytes()),
                ]
            )
            print(*rows[-1], flush=True)
    before = time.process_time()
    run = finish(slam, results, [], interrupted=False)
    final = time.process_time() - before
    assert sequence.groundtruth is not None
    summary = (
        f"\nFinal adjustment: {final:.1f} s, at most {megabytes()} MB. {run.map.num_keyframes} keyframes, "
        f"{len(run.trajectory)} of {len(sequence)} frames posed, "
        f"ATE {evaluate(run.trajectory, sequence.groundtruth).ate_m:.4f} m.\n"
    )
    header = ["frames", "median (ms)", "mean (ms)", "keyframes", "points", "rows of points", "peak (MB)"]
    write_between(Path(__file__).parent / "README.md", table(header, rows) + summary, START, END)
    print(summary)


if __name__ == "__main__":
    main()
