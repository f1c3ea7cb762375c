"""Results folder of a run: overwrite protection and checkpoints."""

from __future__ import annotations

from pathlib import Path

from torchslam.data import Sequence
from torchslam.errors import ResultsError
from torchslam.io.results import CHECKPOINT, results_in
from torchslam.system.checkpoint import write_checkpoint
from torchslam.system.run import RunProgress
from torchslam.system.slam import SLAM
from torchslam.utils.files import write_whole

GROWTH = (
    0.05  # minimum interval as a ratio of the keyframes so far, so that all checkpoints together cost O(n)
)
PROBE = ".torchslam-can-write"


def prepare(folder: Path, overwrite: bool, resume: bool) -> None:
    """Create the results folder and check that it can be written to, before the run.

    Args:
        folder: the results folder.
        overwrite: replace existing results; their checkpoint is deleted at once.
        resume: continue from the checkpoint in the folder.

    Raises:
        ResultsError: if the folder has results that would be lost.
        OSError: if the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / PROBE, b"")
    (folder / PROBE).unlink()
    checkpoint, there = folder / CHECKPOINT, results_in(folder)
    if overwrite:
        checkpoint.unlink(missing_ok=True)
    elif checkpoint.exists() and not resume:
        raise ResultsError(f"{checkpoint}: an unfinished run: --resume continues it, --overwrite replaces it")
    elif there and not checkpoint.exists():
        what = "but no checkpoint to resume from" if resume else "which would be lost"
        raise ResultsError(f"{there[0]}: results of an earlier run, {what}: --overwrite replaces them")


class Checkpoints:
    """Writes a checkpoint every few keyframes, whenever the system state allows it.

    Args:
        every: minimum number of keyframes between checkpoints, which is at least 5 % of all; 0: no checkpoints.
    """

    def __init__(self, folder: Path, every: int, slam: SLAM, so_far: RunProgress, sequence: Sequence) -> None:
        self._path = folder / CHECKPOINT
        self._every = every
        self._run = slam, so_far, sequence
        self._last = self._keyframes()

    def offer(self, at_once: bool = False) -> None:
        """Write a checkpoint after a frame if one is due, or `at_once` before the run ends."""
        slam, so_far, sequence = self._run
        if not self._every or not slam.mapping or not slam.can_checkpoint:
            return
        keyframes = self._keyframes()
        if at_once or keyframes - self._last >= max(self._every, GROWTH * keyframes):
            write_checkpoint(self._path, slam, so_far, sequence)
            self._last = keyframes

    def remove(self) -> None:
        """Delete the checkpoint of a finished run."""
        self._path.unlink(missing_ok=True)

    def _keyframes(self) -> int:
        return sum(submap.map.num_keyframes for submap in self._run[0].atlas)
