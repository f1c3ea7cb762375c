"""Metrics of a run: a dictionary for metrics.json and a summary table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from statistics import mean, median
from typing import Any, TypeVar

import torch

from torchslam.data import Sequence
from torchslam.errors import TrajectoryError
from torchslam.evaluation import Evaluation, ate_apart, evaluate
from torchslam.geometry import transform
from torchslam.geometry.zoom import Zoom
from torchslam.global_mapping.recording import MappedRun
from torchslam.metric.options import KINDS
from torchslam.system.run import Run
from torchslam.types import State, StepResult, Trajectory

Errors = TypeVar("Errors")


def compute_metrics(
    finished: Run, sequence: Sequence, camera: str, log: Callable[[str], None] = lambda words: None
) -> dict[str, Any]:
    """Compute the content of metrics.json, with the errors if there are ground truth and poses to compare.

    Args:
        finished: the run.
        sequence: its images, with the ground truth if known.
        camera: remark on the camera, as of `camera_remark`.
        log: receives the reason if the evaluation is impossible.
    """

    def measured(run: Run, measure: Callable[[Trajectory], Errors]) -> Errors | None:
        if sequence.groundtruth is None or run.failure or not run.results:
            return None
        try:
            return measure(sequence.groundtruth)
        except TrajectoryError as error:
            log(f"no evaluation: {error}")
            return None

    metrics = run_metrics(
        finished,
        measured(finished, lambda truth: evaluate(finished.trajectory, truth)),
        measured(by_frame(finished), lambda truth: ate_apart(finished.online_parts, truth)),
    )
    metrics |= {
        "camera": camera,
        "rolling_shutter": shake_remark(finished),
        "readout": readout_metrics(finished),
        "zoom": None if finished.zoom is None else finished.zoom.plain,
    }
    changes = [
        {"frame": change.frame, "focal_px": float(change.camera.focal)}
        | ({} if change.readout is None else {"readout_ms": 1e3 * float(change.readout.seconds)})
        for change in finished.camera_changes
    ]
    return metrics | check_metrics(finished) | {"camera_changes": changes, "dropped": sequence.dropped}


def readout_metrics(finished: Run) -> dict[str, float] | None:
    """The readout of a rolling shutter, its error and what was given, in milliseconds; None for a global shutter."""
    known = finished.readout
    if known is None:
        return None
    return {"ms": 1e3 * float(known.seconds), "std_ms": 1e3 * known.std, "given_ms": 1e3 * known.prior}


def shake_remark(finished: Run) -> str:
    """Describe a camera that shakes within an image, by residuals that depend on the row; empty if it does not."""
    found = finished.shutter
    if found is None or not found.is_shaken:
        return ""
    return (
        "rolling shutter, and the camera shakes within an image, which is not modeled (the row explains "
        f"{found.by_row:.0%} of the squared errors, the column {found.by_column:.0%}): poses in fast turns are less "
        "accurate"
    )


def by_frame(run: Run) -> Run:
    """The run frame by frame, which is the run itself unless its recording was mapped as a whole."""
    return run.by_frame if isinstance(run, MappedRun) and run.by_frame is not None else run


def check_metrics(run: Run) -> dict[str, Any]:
    """The mapping that was kept, and the check of its map; empty where there was no choice."""
    if not isinstance(run, MappedRun) or run.kept is None:
        return {}
    check, found = run.check, None
    if check is not None:
        found = {name: getattr(check, name) for name in ("pairs", "agreeing", "triplets", "consistent")}
        found |= {"score": check.score, "breaks": list(map(str, check.breaks)), "sentence": check.sentence()}
    return {"mapping": run.kept.value, "mapping_reason": run.why, "check": found}


FEW = 10
"""Minimum number of posed frames for the warning about too many keyframes."""


def run_metrics(
    run: Run, evaluation: Evaluation | None = None, online_ate_m: float | None = None
) -> dict[str, Any]:
    """Compute the metrics of a run, the content of metrics.json.

    - `frames`: frames of the run, unreadable ones included; `posed`: those with a pose in the trajectory;
      `uncertain`: those whose pose was reported as uncertain; `lost`: those in which tracking was lost.
    - `initialized_at`: index of the frame that initialized the map, or None.
    - `submap`: number of the main submap; `posed`, `keyframes`, `points` and `quality` refer to it.
    - `submaps`: counts of every submap, see `submap_counts`; `session`: number of the run on this map.
    - `online_posed`: frames with a pose in the main submap when it was reported frame by frame.
    - `fps`, `ms_median`, `ms_p95`: time of `SLAM.step`, without image decoding; `fps` is the inverse of the mean.
      Those of the online stage where the global map was kept; 0 if no frame was processed online.
      `ms_longest`: the longest time of a frame after the frame that initialized the map.
    - `metric`: how well the unit of the main submap is known to be a meter, see `map.unit.MetricUnit`, or None;
      `unmeasured`: why sources of meters said nothing.
    - With ground truth: the errors of the evaluation, and `online_ate_m`, that of the poses as reported online
      (see `evaluation.ate_apart`).

    `online_posed`, `online_ate_m` and the times are of the run frame by frame.
    """
    online = by_frame(run)
    first = None if online.failure else _start(online.results)
    timed = [result for result in online.results if "total" in result.stage_ms]
    totals = [result.stage_ms["total"] for result in timed]
    later = [] if first is None else [each.stage_ms["total"] for each in timed if each.index > first.index]
    start, posed_ratio = None if run.failure else _start(run.results), 0.0
    if start is not None:
        since = sum(result.index >= start.index for result in run.results)
        posed_ratio = int((run.trajectory.timestamps >= start.timestamp).sum()) / since
    metrics: dict[str, Any] = {
        "frames": len(run.results) + len(run.skipped),
        "posed": len(run.trajectory),
        "online_posed": len(online.online),
        "posed_ratio_after_initialization": posed_ratio,
        "uncertain": sum(result.state is State.UNCERTAIN for result in run.results),
        "lost": sum(result.state is State.LOST for result in run.results),
        "initialized_at": None if start is None else start.index,
        "keyframes": len(run.keyframes),
        "points": run.map.num_points,
        **quality(run),
        "session": run.session,
        "submap": None if run.main is None else run.main.number,
        "submaps": submap_counts(run),
        "fps": 1e3 / mean(totals) if totals else 0.0,
        "ms_median": median(totals) if totals else 0.0,
        "ms_p95": float(torch.tensor(totals or [0.0], dtype=torch.float32, device="cpu").quantile(0.95)),
        "ms_longest": max(later, default=0.0),
        "stage_ms": stage_times(online.results),
        "skipped": run.skipped,
        "interrupted": run.interrupted,
        "failure": run.failure,
        "metric": None if run.metric is None else run.metric.as_dict(),
        "unmeasured": list(run.unmeasured),
    }
    if evaluation is not None:
        metrics |= evaluation.as_dict()
    if online_ate_m is not None:
        metrics["online_ate_m"] = online_ate_m
    return metrics


FAR_PX = 4.0
"""Reprojection error beyond which an observation counts as wrong in the report."""


@torch.no_grad()
def quality(run: Run) -> dict[str, float | None]:
    """Compute the quality of the map over the frames of this run; None without observations.

    - `reprojection_px`: median reprojection error.
    - `far_ratio`: ratio of the observations that are more than `FAR_PX` off, or behind the camera.
    - `track_length`: mean number of frames that observe a point.
    """
    found: dict[str, float | None] = {"reprojection_px": None, "far_ratio": None, "track_length": None}
    if run.map.num_points == 0:
        return found
    graph = run.posed_frames.graph(run.map, run.sensor).global_shutter()
    rows = torch.nonzero(graph.sessions[graph.frame_index] == run.session)[:, 0]
    T_cw, points_w = graph.T_cw[graph.frame_index[rows]], graph.points_w[graph.point_index[rows]]
    pixels, valid = run.camera.project(transform(T_cw, points_w[:, None])[:, 0])
    if bool(valid.any()):
        errors = (pixels - graph.pixels[rows]).norm(dim=-1).where(valid, torch.inf)
        found["reprojection_px"] = float(errors.median())
        found["far_ratio"] = float((errors > FAR_PX).double().mean())
        found["track_length"] = len(rows) / len(torch.unique(graph.point_index[rows]))
    return found


def result_warnings(metrics: Mapping[str, Any]) -> list[str]:
    """Return warnings about a successful run."""
    keyframes, posed = metrics["keyframes"], metrics["posed"]
    found = [shutter] if (shutter := metrics.get("rolling_shutter")) else []
    found += [*(metrics.get("metric") or {}).get("remarks", ()), *metrics.get("unmeasured", ())]
    if posed < FEW or 2 * keyframes < posed or metrics.get("mapping") == "global":
        return found
    return [
        f"{keyframes} of {posed} posed frames are keyframes: too few points are tracked between frames; "
        "use a higher frame rate (--stride, --fps) or more keypoints (features.num_keypoints)",
        *found,
    ]


def submap_counts(run: Run) -> list[dict[str, int]]:
    """Per submap its number, keyframes and points, and of this run's frames those posed, uncertain and lost in it.

    A frame is lost in the submap in which the frame before it was posed, or lost.
    """
    uncertain, lost = Counter[int | None](), Counter[int | None]()
    last: int | None = None
    for result in run.results:
        last = last if result.submap is None else result.submap
        uncertain[last] += result.state is State.UNCERTAIN
        lost[last] += result.state is State.LOST
    return [
        {
            "submap": submap.number,
            "keyframes": submap.map.num_keyframes,
            "points": submap.map.num_points,
            "posed": submap.posed_frames.count(run.session),
            "uncertain": uncertain[submap.number],
            "lost": lost[submap.number],
        }
        for submap in run.submaps
    ]


def stage_times(results: list[StepResult]) -> dict[str, dict[str, float]]:
    """Return median and mean milliseconds and the number of frames of every stage."""
    times: dict[str, list[float]] = {}
    for result in results:
        for stage, milliseconds in result.stage_ms.items():
            times.setdefault(stage, []).append(milliseconds)
    return {
        stage: {"median": median(values), "mean": mean(values), "frames": len(values)}
        for stage, values in times.items()
    }


def summary(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Describe the metrics of a run as rows for `table`."""
    frames, skipped = metrics["frames"], len(metrics["skipped"])
    rows = {"frames": f"{frames}" + (f", {skipped} of them unreadable and skipped" if skipped else "")}
    if metrics.get("dropped"):
        rows["dropped"] = f"{metrics['dropped']} frames (processing too slow)"
    if latency := metrics.get("latency_ms"):
        rows["latency"] = f"{latency['median']:.0f} ms median, {latency['p95']:.0f} ms at 95 %"
    if metrics["initialized_at"] is None:
        return rows | {"map": "none"}
    rows |= {
        "posed": f"{metrics['posed']} ({metrics['posed'] / frames:.1%}), "
        f"{metrics['posed_ratio_after_initialization']:.1%} since initialization at frame {metrics['initialized_at']}",
        "lost": f"{metrics['lost']} frames; {metrics['uncertain']} had an uncertain pose",
        "map": f"{metrics['keyframes']} keyframes, {metrics['points']} points",
    }
    if metrics.get("reprojection_px") is not None:
        rows["quality"] = (
            f"{metrics['reprojection_px']:.2f} px median reprojection error, {metrics['far_ratio']:.1%} of the "
            f"observations off by more than {FAR_PX:g} px, points seen in "
            f"{metrics['track_length']:.1f} frames, {metrics['uncertain'] / frames:.1%} of the frames uncertain"
        )
    check = metrics.get("check")
    if check and check["pairs"]:
        how = {"online": "frame by frame", "global": "global mapping"}[metrics["mapping"]]
        rows["check"] = f"{how}: {check['sentence']}"
    else:
        rows["check"] = "none: no image pairs tested this map, and what it states of itself may be wrong"
    rows |= _describe_submaps(metrics)
    rows |= {"camera": metrics["camera"]} if metrics.get("camera") else {}
    rows |= {"readout": readout_words(readout)} if (readout := metrics.get("readout")) else {}
    rows |= {"zoom": zoom_words(Zoom.from_plain(zoom))} if (zoom := metrics.get("zoom")) else {}
    if metrics["fps"]:  # frames were processed one by one
        rows["speed"] = (
            f"{metrics['fps']:.1f} frames/s; {metrics['ms_median']:.0f} ms a frame (median), "
            f"{metrics['ms_p95']:.0f} ms (95th percentile)"
        )
    return rows | accuracy(metrics) | {"unit": unit_words(metrics)}


def unit_words(metrics: Mapping[str, Any]) -> str:
    """Describe the scale in a line: its error if it is metric, else the options that determine it."""
    metric = metrics.get("metric")
    if metric is not None:
        return str(metric["sentence"])
    flags = ", ".join(kind.options[0].flag for kind in KINDS)
    return f"scale is arbitrary; for meters use {flags}"


def readout_words(readout: Mapping[str, Any]) -> str:
    """Describe the entry `readout` of metrics.json."""
    source = f"given: {readout['given_ms']:g} ms" if readout["given_ms"] else "estimated"
    return (
        f"{readout['ms']:.1f} ± {readout['std_ms']:.1f} ms from the first row to the last ({source}): "
        "rolling shutter, corrected in the final poses"
    )


def zoom_words(zoom: Zoom) -> str:
    """Describe a zoom by its extremes."""
    low, high = int(zoom.ratios.argmin()), int(zoom.ratios.argmax())
    places = ", ".join(
        f"{float(zoom.ratios[row]):.3f} times that of the first frame at frame {int(zoom.frames[row])}"
        for row in sorted((low, high))
    )
    return f"the focal length changes: {places}; undone in keypoints and poses"


def _describe_submaps(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Describe other submaps and earlier sessions as rows for `table`; empty if there are none."""
    rows = {}
    if metrics["session"]:
        (main,) = (submap for submap in metrics["submaps"] if submap["submap"] == metrics["submap"])
        rows["map"] = f"{main['keyframes']} keyframes, {main['points']} points"
        rows["session"] = f"{metrics['session']}, which made {metrics['keyframes']} of the keyframes"
    others = [
        f"submap {submap['submap']}: {submap['posed']} frames posed, {submap['keyframes']} keyframes"
        for submap in metrics["submaps"]
        if submap["submap"] != metrics["submap"]
    ]
    if others:
        rows["submap"] = (
            f"{metrics['submap']}, the main one of {len(metrics['submaps'])}; {'; '.join(others)}"
        )
    return rows


def accuracy(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Describe the errors of a run as rows for `table`; empty without ground truth."""
    if "ate_m" not in metrics:
        return {}
    length = metrics["path_length_m"]
    share = f" ({metrics['ate_m'] / length:.2%} of the path)" if length > 0 else ""
    online = {"online ATE": f"{metrics['online_ate_m']:.4f} m RMSE"} if "online_ate_m" in metrics else {}
    return {
        "ATE": f"{metrics['ate_m']:.4f} m RMSE{share}, Sim(3)-aligned; {metrics['ate_se3_m']:.4f} m without the scale",
        **online,
        "RPE": f"{metrics['rpe']['translation_m']:.4f} m, {metrics['rpe']['rotation_deg']:.3f}° a frame",
        "scale": f"{metrics['scale']:.4f} true meters per map unit",
        "path length": f"{length:.2f} m",
    }


def _start(results: list[StepResult]) -> StepResult | None:
    """Return the frame that initialized the final map, or the first posed frame of a run on a saved map."""
    states = [State.INITIALIZING, *(result.state for result in results)]
    starts = [
        result
        for result, before in zip(results, states, strict=False)
        if result.state is State.TRACKING and before is State.INITIALIZING
    ]
    found = (result for result in results if result.T_cw is not None)
    return starts[-1] if starts else next(found, None)
