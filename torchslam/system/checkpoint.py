"""Checkpoints: the state of a run between two frames in one file, from which the run can be resumed.

A checkpoint is a map file with more in it: results so far, tracking state, evidence of static overlays. Frames that
wait for a pose are left out and stay without one, and so is the frame that the next one would be compared with. There
is no provisional map and no held-back frame, since no checkpoint is written then (`SLAM.can_checkpoint`).
"""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchslam.config import Config, to_toml
from torchslam.data.sequence import Sequence
from torchslam.errors import ResultsError
from torchslam.geometry import Camera, SensorModel
from torchslam.geometry.camera_measurement import with_radial_terms
from torchslam.geometry.rolling_shutter import Readout
from torchslam.geometry.zoom import Zoom
from torchslam.loop_closing.records import pack_closures, unpack_closures
from torchslam.map.atlas import TrackingState
from torchslam.map.file import SavedAtlas, pack_submaps, read_tensors, unpack_submaps, write_tensors
from torchslam.optim.sensor_estimate import SensorEstimate
from torchslam.system.front_end import FeatureExtractor
from torchslam.system.online_camera import CameraChange
from torchslam.system.online_run import RunProgress
from torchslam.system.session import Session
from torchslam.system.slam import SLAM
from torchslam.types import Explanation, MotionModel, Reason, State, StepResult
from torchslam.utils.files import fingerprint

STATES = tuple(State)
"""The order of states in a file."""
TRACKING = "run.tracking."
"""Prefix of the tensors of the tracking state."""
FORMAT = 2
"""Of the state of a run; 1, without a number, had the last motion alone, `velocity`."""
UNKNOWN = "not a whole checkpoint"
"""What errors say of a damaged file."""


def write_checkpoint(path: str | Path, slam: SLAM, so_far: RunProgress, sequence: Sequence) -> None:
    """Write the state after a frame, atomically.

    Raises:
        ValueError: unless `SLAM.can_checkpoint`.
    """
    submap = slam.submap
    if submap is None or not slam.can_checkpoint:
        raise ValueError("a checkpoint needs a confirmed active submap and no pending frames")
    tensors, about = pack_submaps(slam.atlas, slam.camera, slam.session.count, slam.atlas.num_created)
    whole = {column.name: getattr(submap.tracking, column.name) for column in fields(TrackingState)}
    tracking = {TRACKING + name: value for name, value in whole.items() if isinstance(value, Tensor)}
    results, reasons, stages = _packed(so_far.results)
    loops, closures = pack_closures(slam.loop_closer.loop_closures)
    about["run"] = {
        "format": FORMAT,
        "sequence": input_hash(sequence),
        "config": input_hash(slam.config),
        "next": so_far.next,
        "skipped": so_far.skipped,
        "reasons": reasons,
        "stages": stages,
        "last_frame": slam.last_frame,
        "submap": submap.number,
        "tracking": {name: value for name, value in whole.items() if not isinstance(value, Tensor)},
        "num_cull_checked": [each.num_cull_checked for each in slam.atlas],
        "adjustment": slam.mapper.adjustment.is_pending,
        "due": slam.mapper.adjustment.due,
        "loop_precheck": slam.loop_closer.loop_precheck,
        "camera_changes": [
            [change.frame, change.camera.params.tolist(), change.departure, _plain_readout(change.readout)]
            for change in slam.online_camera.changes
        ],
        "next_camera_check": slam.online_camera.next_check,
        "pending_estimate": _plain_estimate(slam.online_camera.pending),
        "readout": _plain_readout(slam.shared_camera.model.readout),
        "loop_closures": closures,
        "zoom": None if slam.zoom is None else slam.zoom.plain,
    }
    write_tensors(
        path,
        tensors
        | tracking
        | results
        | {f"run.{name}": rows for name, rows in loops.items()}
        | {"run.evidence": slam.scene_filter.static_overlay.evidence},
        about,
    )


def read_checkpoint(
    path: str | Path,
    sequence: Sequence,
    config: Config,
    device: torch.device | str = "cpu",
    extractor: FeatureExtractor | None = None,
    motion_model: MotionModel | None = None,
) -> tuple[SLAM, RunProgress]:
    """Read the system and the progress of its run from a checkpoint.

    extractor, motion_model: those that `SLAM` was given; the configured ones if None

    Raises:
        ResultsError: if the file is missing or damaged, was written by another version, or belongs to a run over
            another sequence or with another configuration.
    """
    tensors, about = read_tensors(path)
    run = about.pop("run", None)
    if not isinstance(run, dict):
        raise ResultsError(f"{path}: a map, but not a checkpoint")
    if run.get("format", 1) != FORMAT:
        found = run.get("format", 1)
        raise ResultsError(
            f"{path}: checkpoint format {found}, this version reads format {FORMAT}: run again"
        )
    for what, mine in (("sequence", sequence), ("config", config)):
        if run.get(what) != input_hash(mine):
            word = "configuration" if what == "config" else what
            raise ResultsError(f"{path}: a checkpoint of a run with another {word}")
    own = {name: tensors.pop(name) for name in list(tensors) if name.startswith("run.")}
    saved = unpack_submaps(path, tensors, about, device)
    slam = SLAM(saved.camera, config, extractor, motion_model=motion_model)
    try:
        so_far = RunProgress(run["next"], _results(own, run, device), run["skipped"])
        slam.zoom = None if run["zoom"] is None else Zoom.from_plain(run["zoom"])
        _restore(slam, saved, own, run, device)
    except (
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        IndexError,
        OverflowError,
        RuntimeError,
    ) as error:
        raise ResultsError(f"{path}: {UNKNOWN}: {error}") from None
    return slam, so_far


def input_hash(of: Sequence | Config) -> str:
    """Hash of a sequence or a configuration."""
    if isinstance(of, Config):
        return fingerprint([to_toml(of)])
    files = [of.file_name(index) for index in range(len(of.timestamps))]
    camera = of.camera
    about: list[object] = [of.name, camera.model, camera.size, camera.params.tolist(), of.known_length, files]
    about += [] if of.zoom is None else [of.zoom.plain]
    return fingerprint([about, of.timestamps.cpu().numpy().tobytes()])


def _restore(
    slam: SLAM, saved: SavedAtlas, tensors: dict[str, Tensor], run: dict[str, Any], device: torch.device | str
) -> None:
    """Start the session of a checkpoint in a new system."""
    (submap,) = (submap for submap in saved.atlas if submap.number == run["submap"])
    columns: dict[str, Any] = {
        name.removeprefix(TRACKING): rows.to(device)
        for name, rows in tensors.items()
        if name.startswith(TRACKING)
    }
    submap.tracking = tracking = TrackingState(**run["tracking"], **columns)
    _check_tracking(tracking)
    for rows, count in (
        (tracking.last_inlier_points, len(submap.map.points)),
        (tracking.local_points, len(submap.map.points)),
        (tracking.local_keyframes, submap.map.num_keyframes),
        (tracking.local_keyframes.new_tensor([tracking.reference]), submap.map.num_keyframes),
    ):
        if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < count:
            raise ValueError(f"the tracking state refers to rows outside 0 to {count - 1}")
    for each, num_checked in zip(saved.atlas, run["num_cull_checked"], strict=True):
        each.num_cull_checked = int(num_checked)
    index, timestamp = run["last_frame"]
    session = Session(saved.camera, saved.atlas, saved.sessions - 1)
    slam.start_session(session, submap, (int(index), float(timestamp)))
    precheck = run["loop_precheck"]
    loops = {name.removeprefix("run."): rows for name, rows in tensors.items()}
    slam.loop_closer.restore(
        unpack_closures(loops, run["loop_closures"]),
        None if precheck is None else (int(precheck[0]), bool(precheck[1])),
    )
    changes = [_camera_change(saved.camera, *change) for change in run["camera_changes"]]
    slam.online_camera.restore(
        changes,
        int(run["next_camera_check"]),
        _readout(run["readout"]),
        submap,
        _estimate(saved.camera, run["pending_estimate"]),
    )
    slam.scene_filter.static_overlay.restore(tensors["run.evidence"])
    if run["adjustment"]:  # around the newest keyframe, where the map is as it was at the request
        due = None if run["due"] is None else int(run["due"])
        slam.mapper.adjustment.request(submap.map, submap.map.num_keyframes - 1, due)


def _plain_readout(readout: Readout | None) -> list[float] | None:
    """A readout as JSON has it."""
    return None if readout is None else readout.numbers.tolist()


def _readout(plain: list[float] | None) -> Readout | None:
    """Invert `_plain_readout`; raise ValueError or TypeError for anything else."""
    if plain is None:
        return None
    return Readout.from_numbers(torch.tensor(plain, dtype=torch.float64, device="cpu"))


def _plain_estimate(pending: tuple[int, SensorEstimate] | None) -> list[Any] | None:
    """A pending estimate as JSON has it: when it is due, its camera and readout, what of them is new, the departure."""
    if pending is None:
        return None
    due, found = pending
    sensor = found.sensor
    flags = [found.has_other_camera, found.has_other_readout]
    return [due, sensor.camera.params.tolist(), _plain_readout(sensor.readout), *flags, found.departure]


def _estimate(given: Camera, plain: list[Any] | None) -> tuple[int, SensorEstimate] | None:
    """Invert `_plain_estimate`; raise ValueError or TypeError for anything else."""
    if plain is None:
        return None
    due, params, readout, has_other_camera, has_other_readout, departure = plain
    if not all(isinstance(flag, bool) for flag in (has_other_camera, has_other_readout)):
        raise ValueError("what is new in the estimate of the sensor is unknown")
    camera = _camera(given, params)
    sensor = SensorModel(camera, _readout(readout))
    return int(due), SensorEstimate(sensor, has_other_camera, has_other_readout, float(departure))


def _camera_change(
    given: Camera, frame: int, params: list[float], departure: float, readout: list[float] | None
) -> CameraChange:
    """Raises ValueError where the parameters are no camera's."""
    return CameraChange(int(frame), _camera(given, params), float(departure), _readout(readout))


def _camera(given: Camera, params: list[float]) -> Camera:
    """The camera with these parameters, in the given model or with radial terms. Raises ValueError for no camera."""
    camera = given if len(params) == len(given.params) else with_radial_terms(given)
    found = camera.params.new_tensor(params)
    if found.shape != camera.params.shape or not bool(found.isfinite().all() and (found[:2] > 0).all()):
        raise ValueError(f"the parameters of the camera are {params}")
    return camera.with_params(found)


def _check_tracking(tracking: TrackingState) -> None:
    """Check the types and shapes of a tracking state; raise ValueError or TypeError if they are wrong."""
    count = len(tracking.motions)
    for T, shape in ((tracking.T_cr, ()), (tracking.motions, (count,))):
        if T.shape != (*shape, 4, 4) or not T.is_floating_point() or not bool(T.isfinite().all()):
            raise ValueError("a pose of the tracking state is not a finite 4 x 4 matrix")
    if tracking.intervals.shape != (count,) or not bool(tracking.intervals.isfinite().all()):
        raise ValueError("the tracking state has other motions than intervals")
    for rows in (tracking.last_inlier_points, tracking.local_keyframes, tracking.local_points):
        if rows.ndim != 1 or rows.dtype != torch.int64:
            raise ValueError("the rows of the tracking state are not flat int64 tensors")
    counts, shares = (tracking.reference, tracking.reference_size), (tracking.error, tracking.explained_ratio)
    if not all(type(count) is int for count in counts) or not all(map(math.isfinite, shares)):
        raise ValueError(f"the tracking state has invalid numbers: {counts}, {shares}")


def _packed(results: list[StepResult]) -> tuple[dict[str, Tensor], list[list[Any]], list[str]]:
    """Results as columns, their reasons, and the names of their stages; NaN for what a frame does not have."""
    stages = list(dict.fromkeys(name for result in results for name in result.stage_ms))
    counts = [
        (
            result.index,
            STATES.index(result.state),
            -1 if result.submap is None else result.submap,
            int(result.is_keyframe),
            result.matches,
            result.inliers,
        )
        for result in results
    ]
    times = [[result.stage_ms.get(stage, math.nan) for stage in stages] for result in results]
    columns: dict[str, Any] = {
        "run.counts": torch.tensor(counts, dtype=torch.int64, device="cpu").reshape(-1, 6),
        "run.timestamps": torch.tensor(
            [result.timestamp for result in results], dtype=torch.float64, device="cpu"
        ),
        "run.T_cw": _stack([result.T_cw for result in results], 4),
        "run.covariances": _stack([result.covariance for result in results], 6),
        "run.stage_ms": torch.tensor(times, dtype=torch.float64, device="cpu").reshape(-1, len(stages)),
    }
    return columns, [[_plain(each) for each in result.reasons] for result in results], stages


def _plain(explanation: Explanation) -> list[Any]:
    """The name of a reason and its values, as JSON has them."""
    values = explanation.values.items()
    return [
        explanation.reason.name,
        {name: _plain(value) if isinstance(value, Explanation) else value for name, value in values},
    ]


def _explanation(plain: list[Any]) -> Explanation:
    """Invert `_plain`; raise KeyError, TypeError or ValueError for anything else."""
    name, values = plain
    return Explanation(
        Reason[name],
        {key: _explanation(value) if isinstance(value, list) else value for key, value in values.items()},
    )


def _stack(matrices: list[Tensor | None], size: int) -> Tensor:
    stacked = torch.full((len(matrices), size, size), math.nan, dtype=torch.float64, device="cpu")
    for row, matrix in enumerate(matrices):
        if matrix is not None:
            stacked[row] = matrix.detach()
    return stacked


def _results(tensors: dict[str, Tensor], run: dict[str, Any], device: torch.device | str) -> list[StepResult]:
    """Invert `_packed`."""
    counts, times = tensors["run.counts"].tolist(), tensors["run.stage_ms"].tolist()
    timestamps, stages = tensors["run.timestamps"].tolist(), run["stages"]
    T_cw, covariances = tensors["run.T_cw"].to(device), tensors["run.covariances"].to(device)
    results = []
    for row, (index, state, submap, is_keyframe, matches, inliers) in enumerate(counts):
        results.append(
            StepResult(
                index=index,
                timestamp=timestamps[row],
                state=STATES[state],
                T_cw=None if bool(T_cw[row].isnan().any()) else T_cw[row],
                submap=None if submap < 0 else submap,
                covariance=None if bool(covariances[row].isnan().any()) else covariances[row],
                is_keyframe=bool(is_keyframe),
                matches=matches,
                inliers=inliers,
                reasons=tuple(map(_explanation, run["reasons"][row])),
                stage_ms={
                    stage: time
                    for stage, time in zip(stages, times[row], strict=True)
                    if time == time  # NaN is not itself
                },
            )
        )
    return results
