"""One row in, one row out: a sequence by its name, and the figures of a run over it."""

from __future__ import annotations

import hashlib
import tempfile
import time
import warnings
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import torch

from experiments.trials.judging import extent
from experiments.trials.outcome import timed
from experiments.trials.trials import POSED, drone, opened
from torchslam.config import Config, to_toml
from torchslam.data.sequence import Sequence
from torchslam.data.trajectories import write_trajectory
from torchslam.evaluation import MIN_POSES, evaluate
from torchslam.io.results import TRAJECTORY
from torchslam.system.run import Run
from torchslam.system.slam import SLAM
from torchslam.types import State

NAMES = (*POSED, "standstill", "drone", "synthetic:room")
"""Everything that `make report` runs; unavailable sequences are skipped and listed."""
DIGEST = 16  # digits of a hash, enough to distinguish runs


def run_row(name: str) -> dict[str, Any]:
    """The figures of a run with the default configuration, and the hash of the bytes of its trajectory.

    Times are of the processor: `cpu_s` of the whole run with reading and the last adjustment, `ms_median` and `ms_p95`
    of a frame. `ate`, in the unit of the ground truth, and the `extent` of the true path are there where that is known.
    Raises SequenceError where the sequence is not at hand.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    sequence, config = drone() if name == "drone" else opened(name), Config()
    slam = SLAM(sequence.camera, config)
    frame_ms = timed(slam)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        start = time.process_time()
        run = slam.run(sequence)
        seconds = time.process_time() - start
    states = [result.state for result in run.results]
    return {
        "frames": len(run.results) + len(run.skipped),
        "posed": len(run.trajectory),
        "uncertain": states.count(State.UNCERTAIN),
        "lost": states.count(State.LOST),
        "keyframes": len(run.keyframes),
        "points": run.map.num_points,
        **accuracy(run, sequence),
        "cpu_s": round(seconds, 2),
        "ms_median": round(median(frame_ms), 2),
        "ms_p95": round(float(torch.tensor(frame_ms).quantile(0.95)), 2),
        "trajectory": trajectory_digest(run),
        "config": hashlib.sha256(to_toml(config).encode()).hexdigest()[:DIGEST],
    }


def accuracy(run: Run, sequence: Sequence) -> dict[str, float]:
    """ATE and extent, where there is a truth and enough is posed."""
    if sequence.groundtruth is None or len(run.trajectory) < MIN_POSES:
        return {}
    ate = evaluate(run.trajectory, sequence.groundtruth).ate_m
    return {"ate": round(ate, 6), "extent": round(extent(sequence.groundtruth.positions_w), 4)}


def trajectory_digest(run: Run) -> str:
    """Of the bytes that `torchslam run` would write as trajectory.txt."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / TRAJECTORY
        write_trajectory(path, run.trajectory)
        return hashlib.sha256(path.read_bytes()).hexdigest()[:DIGEST]
