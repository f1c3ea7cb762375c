"""A run that is killed in the middle and resumed from its last checkpoint."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from experiments.trials.edited import Edited
from torchslam.cli.run import CHECKPOINT_EVERY, Checkpoints
from torchslam.config import Config
from torchslam.io.results import CHECKPOINT
from torchslam.system.checkpoint import read_checkpoint
from torchslam.system.online_run import Observer, OnlineRun, RunProgress
from torchslam.system.slam import SLAM
from torchslam.types import StepResult


def after_the_cut(
    make: Callable[[], Edited], config: Config, share: float, every: int = CHECKPOINT_EVERY
) -> tuple[SLAM, RunProgress]:
    """The system and its results by the last checkpoint of a run that was killed after a share of its frames.

    make: the sequence, by a function that can be pickled; every: keyframes from checkpoint to checkpoint
    Raises ResultsError where there is no checkpoint yet.
    """
    with TemporaryDirectory() as folder:
        arguments = make, config, share, every, Path(folder)
        process = multiprocessing.get_context("spawn").Process(target=_run_until_killed, args=arguments)
        process.start()
        process.join()
        if process.exitcode != -signal.SIGKILL:
            raise RuntimeError(f"the run ended with {process.exitcode} before it was killed")
        return read_checkpoint(Path(folder) / CHECKPOINT, make(), config)


def _run_until_killed(
    make: Callable[[], Edited], config: Config, share: float, every: int, folder: Path
) -> None:
    torch.set_num_threads(1)
    sequence, so_far = make(), RunProgress()
    slam = SLAM(sequence.camera, config)
    checkpoints = Checkpoints(folder, every, slam, so_far, sequence)

    def after_frame(result: StepResult) -> None:
        checkpoints.offer()
        if so_far.next >= share * len(sequence):
            os.kill(os.getpid(), signal.SIGKILL)

    OnlineRun(slam, sequence, so_far, observer=Observer(after_frame)).run()
