"""The folder that a run writes to: free, or to be overwritten, or that of a run to go on with."""

from __future__ import annotations

from pathlib import Path

from torchslam.data import Sequence
from torchslam.errors import ResultsError
from torchslam.io.results import CHECKPOINT, results_in
from torchslam.system.checkpoint import write_checkpoint
from torchslam.system.run import RunProgress
from torchslam.system.slam import SLAM
from torchslam.utils.atomic_write import write_whole

GROWTH = 0.05  # checkpoints come as seldom as every so many of the keyframes so far: all of them together cost O(n)
PROBE = ".torchslam-can-write"


def prepare(folder: Path, overwrite: bool, resume: bool) -> None:
    """Make the folder and see that it can be written to: better now than after an hour's run.

    overwrite: what a run left there is given up, its checkpoint at once; resume: it is needed.
    Raises ResultsError where there are results that must stay, OSError where nothing can be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / PROBE, b"")
    (folder / PROBE).unlink()
    checkpoint, there = folder / CHECKPOINT, results_in(folder)
    if overwrite:
        checkpoint.unlink(missing_ok=True)
    elif checkpoint.exists() and not resume:
        raise ResultsError(
            f"{checkpoint}: a run that did not finish: --resume goes on with it, --overwrite gives it up"
        )
    elif there and not checkpoint.exists():
        what = "and there is no checkpoint to resume" if resume else "which would be replaced"
        raise ResultsError(f"{there[0]}: results of an earlier run, {what}: --overwrite gives them up")


class Checkpoints:
    """Takes a checkpoint every so many keyframes, when the system is settled.

    every: keyframes from one to the next, at least, and 5 % of those that there are; 0: none is taken
    """

    def __init__(self, folder: Path, every: int, slam: SLAM, so_far: RunProgress, sequence: Sequence) -> None:
        self._path = folder / CHECKPOINT
        self._every = every
        self._run = slam, so_far, sequence
        self._last = self._keyframes()

    def offer(self, at_once: bool = False) -> None:
        """After a frame: take a checkpoint if it is time for one, or because the run is to end."""
        slam, so_far, sequence = self._run
        if not self._every or not slam.mapping or not slam.can_checkpoint:
            return
        keyframes = self._keyframes()
        if at_once or keyframes - self._last >= max(self._every, GROWTH * keyframes):
            write_checkpoint(self._path, slam, so_far, sequence)
            self._last = keyframes

    def remove(self) -> None:
        """The run has finished."""
        self._path.unlink(missing_ok=True)

    def _keyframes(self) -> int:
        return sum(submap.map.num_keyframes for submap in self._run[0].atlas)
