"""Run one case, check its map, bend it, check it again, and gather all that was decided beside the truth."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

import torchslam
from experiments.common import scaled
from experiments.decisions.cases import Case, half_of, name_of
from experiments.trials.judging import extent, wrong
from torchslam.batch import Columns
from torchslam.data import Sequence
from torchslam.errors import TrajectoryError
from torchslam.evaluation import evaluate
from torchslam.geometry import Camera, se3_inverse, umeyama
from torchslam.geometry.rolling_shutter import Readout
from torchslam.global_mapping.check import MapCheck
from torchslam.global_mapping.recording import KeyframePairs, Mapping, check_run, keyframe_pairs, with_doubts
from torchslam.system.online_camera import CameraChange
from torchslam.system.online_run import Observer
from torchslam.system.run import Run
from torchslam.types import State, StepResult, Trajectory

BENDS = {"1.15": 1.15, "1.2": 1.2, "1/1.2": 1 / 1.2}
"""Scales of the second half of a map, relative to the first one, by which it is bent."""
MIN_BENT_KEYFRAMES = 6
"""Keyframes of a map that is bent: both halves then have pairs of images within them."""


@dataclass
class Stopwatch:
    """Processor seconds since its start."""

    start: float

    @classmethod
    def started(cls) -> Stopwatch:
        return cls(time.process_time())

    def lap(self) -> float:
        """Seconds since the start or the last lap."""
        before, self.start = self.start, time.process_time()
        return self.start - before


def measured(case: Case) -> Columns:
    """Everything that a case shows: truth, decisions on the camera, errors, checks and times, as JSON values."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    clock = Stopwatch.started()
    sequence, truth = case.open(), case.truth
    seconds = {"open": clock.lap()}
    tracked = time.process_time()

    def after_frame(result: StepResult) -> None:
        nonlocal tracked
        tracked = time.process_time()

    run = torchslam.run(sequence, mapping=Mapping.ONLINE, processes=1, observer=Observer(after_frame))
    seconds["final"] = time.process_time() - tracked
    seconds["online"] = clock.lap() - seconds["final"]
    pairs = None if run.failure else keyframe_pairs(run)
    check = None if pairs is None else check_run(run, pairs)
    seconds["check"] = clock.lap()
    given = sequence.camera
    columns = {
        "name": name_of(case),
        "kind": case.kind,
        "half": half_of(case),
        "case": case.description(),
        "frames": len(sequence),
        "truth": {
            "focal": truth.focal,
            "focal_std": truth.focal_std,
            "readout_ms": truth.readout_ms,
        },
        "given": camera_columns(given),
        "changes": [
            {
                "frame": change.frame,
                "departure": change.departure,
                "is_camera": not _is_same(change.camera, before),
                **camera_columns(change.camera),
                "readout_ms": _ms(change.readout),
            }
            for before, change in _with_predecessors(given, run)
        ],
        "final": final_columns(run),
        "failure": run.failure,
        "submaps": len(run.submaps),
        "posed": len(run.trajectory),
        "keyframes": len(run.keyframes),
        "states": Counter(result.state.value for result in run.results),
        "errors": error_columns(run, sequence),
        "check": check_columns(run, check),
    }
    clock.lap()
    columns["bent"] = {} if pairs is None else bent_columns(run, pairs)
    seconds["bent"] = clock.lap()
    return columns | {"seconds": {name: round(value, 3) for name, value in seconds.items()}}


def _with_predecessors(given: Camera, run: Run) -> Iterator[tuple[Camera, CameraChange]]:
    """The changes of the camera, each after the camera in use before."""
    before = given
    for change in run.camera_changes:
        yield before, change
        before = change.camera


def camera_columns(camera: Camera) -> Columns:
    """Focal length in pixels and first radial coefficients."""
    k1, k2 = (0.0, 0.0) if camera.model == "pinhole" else camera.params[4:6].tolist()
    return {"focal": float(camera.focal), "k1": k1, "k2": k2}


def final_columns(run: Run) -> Columns:
    """The camera and the readout of the final adjustment with their standard errors."""
    found = run.calibration
    k1_std, k2_std = (None, None) if found is None else found.radial_std
    focal_std = None if found is None else found.focal_std * float(run.camera.focal)
    return camera_columns(run.camera) | {
        "focal_std": focal_std,
        "k1_std": k1_std,
        "k2_std": k2_std,
        "readout_ms": _ms(run.readout),
        "readout_std_ms": None if run.readout is None else 1e3 * run.readout.std,
        "zoom_extent": None if run.zoom is None else run.zoom.extent,
    }


def error_columns(run: Run, sequence: Sequence) -> Columns:
    """Errors of the positions of the main submap, in units of the truth; empty where they cannot be compared.

    `extent`: diagonal of the box around the true positions of the part; `ate`: final, of all posed frames;
    `ate_online`, `ate_final`: of the frames with a pose by `SLAM.step`; `misplaced`: number of poses that are `wrong`.
    """
    truth = sequence.groundtruth
    if truth is None or run.failure:
        return {}
    first, last = sequence.timestamps[0], sequence.timestamps[-1]
    inside = truth.positions_w[(truth.timestamps >= first - 1e-6) & (truth.timestamps <= last + 1e-6)]
    try:
        final = evaluate(run.trajectory, truth)
        online = evaluate(run.online, truth)
        same = evaluate(_at(run.trajectory, run.online.timestamps), truth)
    except TrajectoryError:  # too few poses, or no motion
        return {}
    whole = extent(inside)
    return {
        "extent": float((inside.amax(0) - inside.amin(0)).norm()),
        "compared": final.compared,
        "ate": final.ate_m,
        "ate_online": online.ate_m,
        "ate_final": same.ate_m,
        "misplaced": int(wrong(final.matched.T_wc, final.groundtruth.T_wc, whole).sum()),
    }


def _at(trajectory: Trajectory, timestamps: Tensor) -> Trajectory:
    """The poses at these times, as far as there are any."""
    rows = torch.isin(trajectory.timestamps, timestamps)
    return Trajectory(trajectory.timestamps[rows], trajectory.T_wc[rows])


def check_columns(run: Run, check: MapCheck | None) -> Columns | None:
    """What the check found, and the numbers of frames with a pose and of those that are uncertain, before and after."""
    if check is None:
        return None
    doubted = with_doubts(run.results, check)
    return {
        "is_right": check.is_right,
        "score": check.score,
        "breaks": dict(Counter(each.kind.name for each in check.breaks)),
        "weak_links": check.weak_links,
        "pairs": check.pairs,
        "agreeing": check.agreeing,
        "triplets": check.triplets,
        "consistent": check.consistent,
        "certain": len(check.certain),
        "uncertain": list(check.uncertain),
        "frames": sum(result.T_cw is not None for result in run.results),
        "uncertain_online": sum(result.state is State.UNCERTAIN for result in run.results),
        "uncertain_frames": sum(result.state is State.UNCERTAIN for result in doubted),
    }


def bent_columns(run: Run, pairs: KeyframePairs) -> Columns:
    """By scale, the check of the map bent by it; empty for a map of too few keyframes.

    `deformation`: RMS distance of the bent keyframes from the others after alignment, as a share of the extent;
    `uncertain`: number of the uncertain keyframes of the first half and of the second one, of `halves`
    """
    rows = run.map.keyframe_rows(run.session)
    if len(rows) < MIN_BENT_KEYFRAMES:
        return {}
    frames = [run.map.frame_features(row).index for row in rows.tolist()]
    half = len(frames) // 2
    found = {}
    for name, factor in BENDS.items():
        with bent(run, factor) as deformation:
            check = check_run(run, pairs)
        assert check is not None
        uncertain = set(check.uncertain)
        found[name] = {
            "is_right": check.is_right,
            "score": check.score,
            "breaks": dict(Counter(each.kind.name for each in check.breaks)),
            "deformation": deformation,
            "halves": [half, len(frames) - half],
            "uncertain": [
                len(uncertain.intersection(frames[:half])),
                len(uncertain.intersection(frames[half:])),
            ],
        }
    return found


@contextmanager
def bent(run: Run, factor: float) -> Iterator[float]:
    """Scale the second half of the main submap about the last keyframe of the first half; afterwards it is as before.

    The points of the second half are those that no keyframe of the first half sees. Yields the deformation.
    """
    slam_map = run.map
    rows = slam_map.keyframe_rows(run.session)
    T_cw, points_w = slam_map.T_cw.clone(), slam_map.positions_w.clone()
    half = len(rows) // 2
    center = se3_inverse(T_cw[rows[half - 1]])[:3, 3]
    is_seen = torch.zeros(len(points_w), dtype=torch.bool)
    is_seen[slam_map.observations(rows[:half]).point_index] = True
    after = slam_map.observations(rows[half:]).point_index.unique()
    after = after[~is_seen[after]]
    moved = scaled(T_cw[rows], factor, about=half - 1)
    slam_map.keyframes["T_cw"][rows] = moved
    slam_map.points["positions_w"][after] = center + factor * (points_w[after] - center)
    try:
        yield deformation_of(T_cw[rows], moved)
    finally:
        slam_map.keyframes["T_cw"][:] = T_cw
        slam_map.points["positions_w"][:] = points_w


def deformation_of(T_cw: Float[Tensor, "K 4 4"], moved: Float[Tensor, "K 4 4"]) -> float:
    """RMS distance of moved cameras from the others after alignment, as a share of the box around the others."""
    before, after = se3_inverse(T_cw)[:, :3, 3], se3_inverse(moved)[:, :3, 3]
    s, R, t = umeyama(after, before)
    errors = (s * after @ R.mT + t - before).square().sum(-1).mean().sqrt()
    return float(errors / (before.amax(0) - before.amin(0)).norm())


def _is_same(one: Camera, other: Camera) -> bool:
    return camera_columns(one) == camera_columns(other)


def _ms(readout: Readout | None) -> float | None:
    return None if readout is None else 1e3 * float(readout.seconds)
