"""Metrics of a run: a dictionary for metrics.json and a summary table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import mean, median
from typing import Any

import torch

from torchslam.evaluation import Evaluation
from torchslam.geometry import transform
from torchslam.system.run import Run
from torchslam.types import State, StepResult
from torchslam.utils.text_table import table as table

FEW = 10
"""Posed frames of which it says nothing how many are keyframes."""


def metrics(
    run: Run, evaluation: Evaluation | None = None, online_ate_m: float | None = None
) -> dict[str, Any]:
    """Compute the metrics of a run, the content of metrics.json.

    - `frames`: frames of the run, unreadable ones included; `posed`: those with a pose in the trajectory;
      `uncertain`: those whose pose was reported as uncertain; `lost`: those in which tracking was lost.
    - `initialized_at`: index of the frame that initialized the map, or None.
    - `submap`: number of the main submap; `posed`, `keyframes`, `points` and `quality` refer to it.
    - `submaps`: counts of every submap, see `submap_counts`; `session`: number of the run on this map.
    - `fps`, `ms_median`, `ms_p95`: time of `SLAM.step`, without image decoding; `fps` is the inverse of the mean.
    - With ground truth: the errors of the evaluation, and `online_ate_m`, that of the poses as reported online
      (see `evaluation.ate_apart`).
    """
    totals = [result.stage_ms["total"] for result in run.results if "total" in result.stage_ms]
    start = None if run.failure else _start(run.results)
    figures: dict[str, Any] = {
        "frames": len(run.results) + len(run.skipped),
        "posed": len(run.trajectory),
        "posed_ratio_after_initialization": _posed_share(run, start),
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
        "ms_p95": float(torch.tensor(totals).quantile(0.95)) if totals else 0.0,
        "stage_ms": stage_times(run.results),
        "skipped": run.skipped,
        "interrupted": run.interrupted,
        "failure": run.failure,
    }
    if evaluation is not None:
        figures |= evaluation.as_dict()
    if online_ate_m is not None:
        figures["online_ate_m"] = online_ate_m
    return figures


@torch.no_grad()
def quality(run: Run) -> dict[str, float | None]:
    """How well the map explains what this run's frames saw of it; None where they saw nothing.

    reprojection_px: mean distance of the points' projections from the observed pixels
    track_length:    in how many of the frames a point was seen, in the mean
    """
    found: dict[str, float | None] = {"reprojection_px": None, "track_length": None}
    if run.main is None or run.map.num_points == 0:
        return found
    graph = run.posed_frames.graph(run.map, run.camera)
    rows = torch.nonzero(graph.sessions[graph.frame_index] == run.session)[:, 0]
    T_cw, points_w = graph.T_cw[graph.frame_index[rows]], graph.points_w[graph.point_index[rows]]
    pixels, valid = run.camera.project(transform(T_cw, points_w[:, None])[:, 0])
    if bool(valid.any()):
        found["reprojection_px"] = float((pixels - graph.pixels[rows])[valid].norm(dim=-1).mean())
        found["track_length"] = len(rows) / len(torch.unique(graph.point_index[rows]))
    return found


def result_warnings(figures: Mapping[str, Any]) -> list[str]:
    """What speaks against a run that went well, in words."""
    keyframes, posed = figures["keyframes"], figures["posed"]
    if posed < FEW or 2 * keyframes < posed:
        return []
    return [
        f"{keyframes} of {posed} posed frames are keyframes: from frame to frame too little is found again; "
        "take the frames closer together (--stride, --fps), or more keypoints (features.num_keypoints)"
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


def stage_times(results: Sequence[StepResult]) -> dict[str, dict[str, float]]:
    """Per stage the median and mean milliseconds over the frames in which it ran, and in how many it ran."""
    times: dict[str, list[float]] = {}
    for result in results:
        for stage, milliseconds in result.stage_ms.items():
            times.setdefault(stage, []).append(milliseconds)
    return {
        stage: {"median": median(values), "mean": mean(values), "frames": len(values)}
        for stage, values in times.items()
    }


def summary(figures: Mapping[str, Any]) -> dict[str, str]:
    """The metrics of a run in words, label by label, for `table`."""
    frames, skipped = figures["frames"], len(figures["skipped"])
    rows = {"frames": f"{frames}" + (f", {skipped} of them unreadable and skipped" if skipped else "")}
    if figures.get("dropped"):
        rows["dropped"] = f"{figures['dropped']} frames (processing too slow)"
    if latency := figures.get("latency_ms"):
        rows["latency"] = f"{latency['median']:.0f} ms in the median, {latency['p95']:.0f} ms at 95 %"
    if figures["initialized_at"] is None:
        return rows | {"map": "none"}
    rows |= {
        "posed": f"{figures['posed']} ({figures['posed'] / frames:.1%}), "
        f"{figures['posed_ratio_after_initialization']:.1%} since the start at frame {figures['initialized_at']}",
        "lost": f"{figures['lost']} frames; {figures['uncertain']} had an uncertain pose",
        "map": f"{figures['keyframes']} keyframes, {figures['points']} points",
    }
    if figures.get("reprojection_px") is not None:
        rows["quality"] = (
            f"{figures['reprojection_px']:.2f} px mean reprojection error, points seen in "
            f"{figures['track_length']:.1f} frames, {figures['uncertain'] / frames:.1%} of the frames uncertain"
        )
    rows |= _beside(figures)
    rows |= {"camera": figures["camera"]} if figures.get("camera") else {}
    rows |= {
        "speed": f"{figures['fps']:.1f} frames/s; {figures['ms_median']:.0f} ms a frame (median), "
        f"{figures['ms_p95']:.0f} ms (95th percentile)",
    }
    return rows | accuracy(figures)


def _beside(figures: Mapping[str, Any]) -> dict[str, str]:
    """The submaps beside the main one, and the sessions before this one, in words; nothing where there are none."""
    rows = {}
    if figures["session"]:
        (main,) = (submap for submap in figures["submaps"] if submap["submap"] == figures["submap"])
        rows["map"] = f"{main['keyframes']} keyframes, {main['points']} points"
        rows["session"] = f"{figures['session']}, which made {figures['keyframes']} of the keyframes"
    others = [
        f"submap {submap['submap']}: {submap['posed']} frames posed, {submap['keyframes']} keyframes"
        for submap in figures["submaps"]
        if submap["submap"] != figures["submap"]
    ]
    if others:
        rows["submap"] = (
            f"{figures['submap']}, the main one of {len(figures['submaps'])}; {'; '.join(others)}"
        )
    return rows


def accuracy(figures: Mapping[str, Any]) -> dict[str, str]:
    """The figures of an evaluation in words; nothing where there was no ground truth."""
    if "ate_m" not in figures:
        return {}
    length = figures["path_length_m"]
    share = f" ({figures['ate_m'] / length:.2%} of the path)" if length > 0 else ""
    online = {"online ATE": f"{figures['online_ate_m']:.4f} m RMSE"} if "online_ate_m" in figures else {}
    return {
        "ATE": f"{figures['ate_m']:.4f} m RMSE{share}, Sim(3)-aligned; {figures['ate_se3_m']:.4f} m without the scale",
        **online,
        "RPE": f"{figures['rpe']['translation_m']:.4f} m, {figures['rpe']['rotation_deg']:.3f}° a frame",
        "scale": f"{figures['scale']:.4f} true meters per map unit",
        "path length": f"{length:.2f} m",
    }


def _start(results: Sequence[StepResult]) -> StepResult | None:
    """The frame that started the map that the run ended with, a map given up before does not count, or found it."""
    states = [State.INITIALIZING, *(result.state for result in results)]
    starts = [
        result
        for result, before in zip(results, states, strict=False)
        if result.state is State.TRACKING and before is State.INITIALIZING
    ]
    found = (result for result in results if result.T_cw is not None)
    return starts[-1] if starts else next(found, None)


def _posed_share(run: Run, start: StepResult | None) -> float:
    """Posed frames among those from the start of the map on."""
    if start is None:
        return 0.0
    since = sum(result.index >= start.index for result in run.results)
    return int((run.trajectory.timestamps >= start.timestamp).sum()) / since
