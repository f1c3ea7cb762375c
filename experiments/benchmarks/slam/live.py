"""Does a live run keep up? A recording is played at the rate of its camera, and late frames are dropped.

python -m experiments.benchmarks.slam.live redkitchen
"""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import torch

from experiments.common import DATA_DIR, parser_of
from torchslam.config import load_config
from torchslam.data import open_sequence
from torchslam.data.readers.live import LiveSequence
from torchslam.data.sequence import Sequence
from torchslam.evaluation import evaluate
from torchslam.system.online_run import Observer, OnlineRun
from torchslam.system.slam import SLAM
from torchslam.types import StepResult, Trajectory


class Player:
    """The images of a recording at the rate of its camera: a frame that is not read in time is lost."""

    def __init__(self, sequence: Sequence, rate: float) -> None:
        self.paths = [sequence.image_name(index) for index in range(len(sequence))]
        self.rate = rate
        self.start: float | None = None
        self.began = 0.0  # seconds since 1970 of the first frame
        self.frame = -1

    def grab(self) -> bool:
        self.start = time.monotonic() if self.start is None else self.start
        self.frame += 1
        time.sleep(max(0.0, self.start + self.frame / self.rate - time.monotonic()))
        self.began = self.began or time.time()
        return self.frame < len(self.paths)

    def retrieve(self) -> tuple[bool, np.ndarray]:
        image = cv2.imread(self.paths[self.frame], cv2.IMREAD_GRAYSCALE)
        return image is not None, np.empty(0) if image is None else image

    def get(self, property_id: int) -> float:
        return 1e3 * self.frame / self.rate if property_id == cv2.CAP_PROP_POS_MSEC else 0.0

    def release(self) -> None:
        pass


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("name")
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--processes", type=int)
    options = parser.parse_args()
    torch.set_num_threads(1)
    recording = open_sequence(DATA_DIR / options.name, limit=options.limit)
    slam = SLAM(recording.camera, load_config(options.config))
    player = Player(recording, options.rate)
    live = LiveSequence(options.name, player, recording.camera)
    latencies: list[float] = []

    def after_frame(result: StepResult) -> None:
        latencies.append(1e3 * (time.time() - result.timestamp))

    finished = OnlineRun(slam, live, None, options.processes, Observer(after_frame)).run()
    median, p95 = torch.tensor(latencies).quantile(torch.tensor([0.5, 0.95])).tolist()
    print(
        f"{options.name} at {options.rate:g} Hz: {len(finished.results)} frames, {live.dropped} dropped "
        f"({live.dropped / len(recording):.1%}), latency {median:.0f} ms in the median, {p95:.0f} ms at 95 %, "
        f"posed {len(finished.trajectory)}, ATE {ate(finished.trajectory, recording, player.began, options.rate):.4f} m"
    )


def ate(trajectory: Trajectory, recording: Sequence, begin: float, rate: float) -> float:
    """ATE of poses at the times of the player, in meters; NaN without ground truth."""
    if recording.groundtruth is None:
        return float("nan")
    frames = ((trajectory.timestamps - begin) * rate).round().long()
    return evaluate(Trajectory(recording.timestamps[frames], trajectory.T_wc), recording.groundtruth).ate_m


if __name__ == "__main__":
    main()
