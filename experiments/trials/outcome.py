"""Run a trial and evaluate it."""

from __future__ import annotations

import math
import tempfile
import time
import warnings
from collections.abc import Sequence as Rows
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from experiments.trials.cut import after_the_cut
from experiments.trials.edited import Edited
from experiments.trials.judging import extent, wrong
from experiments.trials.trials import Trial
from torchslam.config import Config, load_config
from torchslam.evaluation import MIN_POSES, evaluate
from torchslam.geometry import se3_inverse, so3_log
from torchslam.loop_closing.loop_detector import LoopClosureRecord
from torchslam.system.online_run import OnlineRun, RunProgress
from torchslam.system.run import Run
from torchslam.system.slam import SLAM
from torchslam.types import Frame, State, StepResult

LETTERS = {State.INITIALIZING: "i", State.TRACKING: "T", State.UNCERTAIN: "U", State.LOST: "L"}
MAX_LISTED = 8  # stretches of states, and loop closures, in the table


@dataclass(frozen=True)
class Outcome:
    """The result of a run over an edited sequence.

    posed:    frames with a pose in the main submap that can have one
    possible: frames that can have a pose
    strays:   frames with a pose in the main submap that cannot have one
    submaps:  frames of each submap, the main one first
    ate:      in units of the truth; None with too few poses
    extent:   of the true path
    misled:   frames with the state tracking whose online or final pose in the main submap is wrong
    states:   one per frame
    loop_closures: recognized places
    apart:    largest true distance of a loop closure: meters and degrees; None without truth
    seconds:  processor time of the run (after a cut: of its rest), with reading of images and final adjustment
    ms:       processor time of `SLAM.step`, median
    failure:  why there is no map
    """

    posed: int
    possible: int
    strays: int
    submaps: list[int]
    ate: float | None
    extent: float
    misled: list[int]
    states: list[State]
    loop_closures: list[LoopClosureRecord]
    apart: tuple[float, float] | None
    seconds: float
    ms: float
    failure: str


def timed(slam: SLAM) -> list[float]:
    """Record the processor time of each following `step`, in ms."""
    taken: list[float] = []
    step = slam.step

    def measured(frame: Frame) -> StepResult:
        before = time.process_time()
        result = step(frame)
        taken.append(1e3 * (time.process_time() - before))
        return result

    slam.step = measured  # type: ignore[method-assign]
    return taken


def perform(trial: Trial, more: Rows[str] = ()) -> tuple[Outcome, Run]:
    """Run a trial; `more` settings come after its own. Raises SequenceError if its frames are not available."""
    config = load_config(None, [*trial.settings, *more])
    sequence = trial.sequence()
    slam, so_far = _begin(trial, sequence, config)
    known = {result.index for result in so_far.results if result.state is State.TRACKING}
    taken = timed(slam)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = time.process_time()
        run = OnlineRun(slam, sequence, so_far).run()
        seconds = time.process_time() - start
    assert known <= set(final_poses(run)), "frames tracked before the last checkpoint lost their poses"
    return _outcome(run, sequence, seconds, taken), run


def _begin(trial: Trial, sequence: Edited, config: Config) -> tuple[SLAM, RunProgress]:
    """The system before the first frame of the trial, or after the last one that was not lost with a cut."""
    if trial.cut_at is not None:
        return after_the_cut(trial.sequence, config, trial.cut_at)
    if trial.map_of is None:
        return SLAM(sequence.camera, config), RunProgress()
    return _in_map(trial.map_of(), config), RunProgress()


def _in_map(sequence: Edited, config: Config) -> SLAM:
    """A system that only localizes, in the saved map of another run."""
    slam = SLAM(sequence.camera, config)
    slam.run(sequence)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.safetensors"
        slam.save(path)
        return SLAM.load(path, config, mapping=False)


def _outcome(run: Run, sequence: Edited, seconds: float, taken: list[float]) -> Outcome:
    final, truth = final_poses(run), sequence.groundtruth
    ate = None
    if truth is not None and sum(sequence.pose(index) is not None for index in final) >= MIN_POSES:
        ate = evaluate(run.trajectory, truth).ate_m
    posed = sum(bool(sequence.belongs[index]) for index in final)
    return Outcome(
        posed=posed,
        possible=int(sequence.belongs.sum()),
        strays=len(final) - posed,
        submaps=sorted((submap.posed_frames.count(run.session) for submap in run.submaps), reverse=True),
        ate=ate,
        extent=0.0 if truth is None else extent(truth.positions_w),
        misled=misled(run, sequence),
        states=[result.state for result in run.results],
        loop_closures=list(run.loop_closures),
        apart=furthest(list(run.loop_closures), sequence),
        seconds=seconds,
        ms=median(taken),
        failure=run.failure,
    )


def final_poses(run: Run) -> dict[int, Tensor]:
    """Final T_cw (4, 4) of the frames of the main submap, by frame number."""
    if run.main is None or len(run.main.posed_frames) == 0:
        return {}
    frames = run.main.posed_frames.frames
    T_cw = run.main.posed_frames.T_cw(run.main.map)
    rows = torch.nonzero(frames["session"] == run.session)[:, 0]
    return {int(frames["frame_index"][row]): T_cw[row] for row in rows.tolist()}


def online_poses(run: Run) -> dict[int, Tensor]:
    """Online T_cw (4, 4) of the frames that were tracking in the main submap, by frame number.

    Uncertain poses are excluded: many of them would distort the alignment.
    """
    if run.main is None:
        return {}
    number = run.main.number
    return {
        result.index: result.T_cw
        for result in run.results
        if result.T_cw is not None and result.submap == number and result.state is State.TRACKING
    }


def misled(run: Run, sequence: Edited) -> list[int]:
    """The frames with the state tracking whose online or final pose in the main submap is wrong."""
    bad = wrong_frames(final_poses(run), sequence) | wrong_frames(online_poses(run), sequence)
    return [result.index for result in run.results if result.state is State.TRACKING and result.index in bad]


def wrong_frames(poses: dict[int, Tensor], sequence: Edited) -> set[int]:
    """The frames of one submap whose poses T_cw are wrong; those of strays always are."""
    strays = {index for index in poses if not sequence.belongs[index]}
    pairs = {
        index: (poses[index], pose) for index in sorted(poses) if (pose := sequence.pose(index)) is not None
    }
    if not pairs or sequence.groundtruth is None:
        return strays
    given, true = (
        se3_inverse(torch.stack(side).to(torch.float64)) for side in zip(*pairs.values(), strict=True)
    )
    bad = wrong(given, true, extent(sequence.groundtruth.positions_w))
    return strays | {index for index, is_bad in zip(pairs, bad.tolist(), strict=True) if is_bad}


def furthest(loop_closures: list[LoopClosureRecord], sequence: Edited) -> tuple[float, float] | None:
    """The largest distance (meters) and angle (degrees) between a frame and the place of its loop closure."""
    meters, degrees = [], []
    for closure in loop_closures:
        here, there = sequence.pose(closure.frame), sequence.pose(closure.matched_frame)
        if here is None or there is None:
            continue
        motion = se3_inverse(here) @ there
        meters.append(float((se3_inverse(here) - se3_inverse(there))[:3, 3].norm()))
        degrees.append(math.degrees(float(so3_log(motion[:3, :3]).norm())))
    return (max(meters), max(degrees)) if meters else None


HEADER = ["trial", "posed", "submaps", "ATE", "wrong & tracking", "states", "loop closures", "s, ms a frame"]


def cells(name: str, outcome: Outcome, unit: str) -> list[str]:
    """The row of the table."""
    return [
        name,
        f"{outcome.posed} of {outcome.possible}" + f", and {outcome.strays} strays" * bool(outcome.strays),
        " + ".join(map(str, outcome.submaps)) or "none",
        _ate(outcome, unit),
        _misled(outcome),
        states_in_short(outcome.states),
        _loop_closures(outcome),
        f"{outcome.seconds:.0f}, {outcome.ms:.0f}",
    ]


def states_in_short(states: list[State]) -> str:
    """Run-length encoding of the states by their letters."""
    stretches = [f"{LETTERS[state]}{len(list(group))}" for state, group in groupby(states)]
    return " ".join(stretches[:MAX_LISTED]) + " …" * (len(stretches) > MAX_LISTED)


def _ate(outcome: Outcome, unit: str) -> str:
    if outcome.ate is None:
        return outcome.failure or "too few poses"
    return f"{outcome.ate:.4f} {unit}" if unit else f"{outcome.ate / outcome.extent:.2%} of the extent"


def _misled(outcome: Outcome) -> str:
    share = len(outcome.misled) / len(outcome.states)
    return f"{len(outcome.misled)} ({share:.1%})" if outcome.misled else "0"


def _loop_closures(outcome: Outcome) -> str:
    listed = [
        f"{closure.frame}→{closure.matched_frame}"
        + " in another submap" * (closure.submap != closure.matched_submap)
        for closure in outcome.loop_closures
    ]
    text = ", ".join(listed[:MAX_LISTED]) + f" and {len(listed) - MAX_LISTED} more" * (
        len(listed) > MAX_LISTED
    )
    if outcome.apart is not None:
        text += f"; within {outcome.apart[0]:.2g} m, {outcome.apart[1]:.0f}°"
    return text or "none"
