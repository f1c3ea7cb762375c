"""view.html: map, path, cameras and errors of a run as a self-contained page; and the data of its ruler."""

from __future__ import annotations

import base64
import html
import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Num
from torch import Tensor

from torchslam.data.trajectories import nearest
from torchslam.dense.cloud import PointCloud
from torchslam.geometry import Camera, se3_inverse, sim3_scale, transform
from torchslam.geometry.transforms import upright_rotation
from torchslam.io.export.ply import upright_from_map
from torchslam.io.export.recording import gaps
from torchslam.io.plots.charts import robust_box, thin
from torchslam.io.report import unit_words
from torchslam.io.results import Results, aligned, aligned_poses
from torchslam.map.atlas import Submap
from torchslam.map.map import NO_POINT, Map
from torchslam.map.observation_index import first_of_each
from torchslam.types import State, Trajectory
from torchslam.utils.console import printable

VIEW = "view.html"
SCRIPTS = (
    "detail.js",
    "draw.js",
    "orbit.js",
    "scene.js",
    "ruler.js",
    "view.js",
)  # in this order, all in one script
MAX_POINTS = 150_000  # of all submaps together: 42 bytes each in the page
MAX_DENSE_POINTS = 500_000  # of the dense cloud: 12 bytes each in the page
STEPS = 65535  # of 16 bits: of the dense cloud over its extent, of pixels over the image
FACTOR_STEPS = 127
"""Steps of an entry of the factor of a covariance, over the largest one of the point: half a percent is enough."""
MAX_FRAMES = 20_000  # 100 bytes each in the page
MAX_SLOPE = 2.0  # tangent of the widest half angle of view that is drawn: a fisheye has no pyramid


def write_view(results: Results, directory: Path) -> Path:
    """Write the page into a results folder and return its file; deterministic."""
    path = directory / VIEW
    path.write_text(page(results), encoding="utf-8")
    return path


def page(results: Results) -> str:
    """Return the page with style, scripts and data."""
    data, folder = page_data(results), files("torchslam.io.viewer")
    names = (*SCRIPTS, "view.css", "view.html")
    asset = {name: (folder / name).read_text(encoding="utf-8") for name in names}
    parts = {
        "title": html.escape(data["title"]),
        "css": asset["view.css"],
        # The data must not contain `</script>`.
        "data": json.dumps(data, separators=(",", ":"), default=encoded).replace("<", "\\u003c"),
        "script": "".join(asset[name] for name in SCRIPTS),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], asset["view.html"])


def page_data(results: Results) -> dict[str, Any]:
    """Return the data of the page; deterministic.

    `frames` has a row per displayed frame: index, seconds since the first one, state and so on. `submaps` has
    those with frames of the run, the main one first, see `_submap`.
    """
    metrics, states = results.metrics, list(State)
    frames = [results.frames[row] for row in thin(len(results.frames), MAX_FRAMES)]
    times = torch.tensor([frame.timestamp for frame in frames], dtype=torch.float64, device="cpu")
    reasons = list(dict.fromkeys(frame.reason for frame in frames))
    number_of = {reason: number for number, reason in enumerate(reasons)}
    paths = {metrics["submap"]: results.trajectory} | results.others
    shown = [submap for submap in results.submaps if len(paths.get(submap.number, ()))]
    shown.sort(key=lambda submap: submap.number != metrics["submap"])
    budget = MAX_POINTS / max(sum(submap.map.num_points for submap in shown), 1)
    accuracy = f" · ATE {metrics['ate_m']:.3g} m" if "ate_m" in metrics else ""
    unit = f" · {unit_words(metrics)}" if metrics.get("metric") else ""
    shutter = "" if results.readout is None else f" · readout {results.readout.description()}"
    return {
        "title": printable(Path(metrics.get("source") or "torchslam").name),
        "facts": f"{len(results.frames)} frames, {metrics['posed']} posed{accuracy}{unit}{shutter}",
        "failure": printable(metrics.get("failure", "")),
        "corners": image_corners(results.camera).tolist(),
        "size": list(results.camera.size),
        "reasons": reasons,
        "frames": {
            "index": numbers([frame.index for frame in frames], "int32"),
            "seconds": numbers(times - times[:1], "float64"),
            "state": numbers([states.index(frame.state) for frame in frames], "uint8"),
            "keyframe": numbers([frame.is_keyframe for frame in frames], "uint8"),
            "inliers": numbers([frame.inliers for frame in frames], "int32"),
            "reason": numbers([number_of[frame.reason] for frame in frames], "int32"),
        },
        "submaps": [
            _submap(submap, paths[submap.number], results, times, int(budget * submap.map.num_points))
            for submap in shown
        ],
    }


def _submap(
    submap: Submap, path: Trajectory, results: Results, times: Tensor, max_points: int
) -> dict[str, Any]:
    """Return the data of a submap: upright, centered on its box; aligned with ground truth, which is in meters.

    Returns:
        S_shown_map: (4, 4) similarity from the map to the view
        frame, keyframe: (F,), (K,) rows of `frames`
        poses, keyframe_poses: (F, 3, 4), (K, 3, 4) camera to world
        errors: (F,) meters, NaN if unknown
        breaks: rows before which the path is interrupted
        truth: (M, 3) true positions
        unit_std: relative standard error of lengths in meters; 0 where the unit is none, or that of the ground truth
        level: whether z is known to be up
        points, colors: (P, 3); points without an observed image have no color
        points_total: number of points before thinning
        seen_frame, seen_pixel, error_step, error_factor: image points and errors of the points, see `of_points`
        dense: the dense cloud, see `_dense`; None if there is none
        box: (2, 3) lowest and highest corner around the scene
        radius: half the diagonal of the box
    """
    is_main = submap.number == results.metrics["submap"]
    cloud = results.cloud if is_main else None
    evaluation = results.evaluation(path)
    up = torch.eye(4, dtype=torch.float64, device="cpu")
    S = up.clone() if evaluation is None else evaluation.S_groundtruth_estimate
    keyframes = submap.map.keyframe_trajectory(results.session)
    level = submap.metric is not None and submap.metric.is_level
    if evaluation is None:
        up[:3, :3] = upright_from_map(submap.map, submap.metric)
    elif level:
        up[:3, :3] = S[:3, :3].mT / sim3_scale(S)  # the axes of the map
    else:
        up[:3, :3] = upright_rotation(aligned_poses(se3_inverse(submap.map.T_cw), S))
    S = up @ S
    points_w, ids = _points(submap)
    limits = robust_box(aligned(path, S).positions_w.numpy(), transform(S, points_w).numpy())
    box = torch.from_numpy(limits.T.copy())
    S[:3, 3] -= box.mean(dim=0)
    box = box - box.mean(dim=0)
    errors = torch.full((len(path),), torch.nan, dtype=torch.float64, device="cpu")
    truth = torch.zeros(0, 3, dtype=torch.float64, device="cpu")
    if evaluation is not None:
        errors[nearest(evaluation.matched.timestamps, path.timestamps)[0]] = evaluation.errors_m
        to_shown = S @ torch.linalg.inv(evaluation.S_groundtruth_estimate)
        during = results.truth(*path.timestamps[[0, -1]].tolist())
        truth = transform(to_shown, during.positions_w)
        truth = truth[thin(len(truth), MAX_FRAMES)]
    frame, rows = _shown_rows(path.timestamps, times)
    keyframe, keyframe_rows = _shown_rows(keyframes.timestamps, times)
    shown, kept = aligned(path, S).T_wc[rows], torch.from_numpy(thin(len(points_w), max_points))
    colors = submap.map.points["colors"][ids] if len(ids) else ids.new_zeros(0, 3)
    breaks = gaps(frame)
    steps = shown[:, :3, 3].diff(dim=0).norm(dim=-1)
    steps[[row - 1 for row in breaks]] = 0.0
    radius = float((box[1] - box[0]).norm()) / 2
    return {
        "name": f"{submap.number}" + (", the main one" if is_main else ""),
        "unit": "" if evaluation is None and submap.metric is None else "m",
        "unit_std": submap.metric.relative_std if evaluation is None and submap.metric is not None else 0.0,
        "level": level,
        "S_shown_map": S.tolist(),
        "frame": numbers(frame, "int32"),
        "poses": numbers(shown[:, :3], "float32"),
        "errors": numbers(errors[rows], "float32"),
        "breaks": breaks,
        "path_length": float(steps.sum()),
        "truth": numbers(truth, "float32"),
        "keyframe": numbers(keyframe, "int32"),
        "keyframe_poses": numbers(aligned(keyframes, S).T_wc[keyframe_rows][:, :3], "float32"),
        "points": numbers(transform(S, points_w)[kept], "float32"),
        "colors": numbers(colors[kept] if bool(colors.any()) else colors[:0], "uint8"),
        "points_total": len(points_w),
        **of_points(submap.map, ids[kept], S, results.session, results.camera.size),
        "dense": None if cloud is None else _dense(cloud, S, box),
        "box": box.tolist(),
        "radius": radius,
        "frustum": 0.035 * radius,
    }


def _dense(cloud: PointCloud, S: Float[Tensor, "4 4"], box: Float[Tensor, "2 3"]) -> dict[str, Any]:
    """Return the data of the dense cloud, whose points are whole numbers of steps from the lowest corner.

    `total` is the number of points before thinning, `spacing` the usual distance between neighbors.
    """
    reach = 4.0 * float((box[1] - box[0]).norm()) / 2  # the dense cloud is cut off there
    near = (transform(S, cloud.points_w.double()).abs() <= reach).all(dim=-1)
    kept = cloud[near].thinned(MAX_DENSE_POINTS)
    points = transform(S, kept.points_w.double())
    low, high = (points.amin(0), points.amax(0)) if len(points) else (S[:3, 3], S[:3, 3])
    step = (high - low).clamp(min=1e-9) / STEPS
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "points": numbers(((points - low) / step).round(), "uint16"),
        "colors": numbers(kept.colors, "uint8"),
        "total": len(cloud),
        "spacing": float(sim3_scale(S)) * kept.spacing(),
    }


def _points(submap: Submap) -> tuple[Float[Tensor, "N 3"], Int[Tensor, " N"]]:
    """Return positions and rows of the valid points."""
    if submap.map.num_points == 0:
        nothing = torch.zeros(0, 3, dtype=torch.float64, device="cpu")
        return nothing, nothing[:, 0].long()
    ids = submap.map.valid_points()
    positions_w = submap.map.positions_w[ids].double()
    finite = positions_w.isfinite().all(dim=-1)
    return positions_w[finite], ids[finite]


def _shown_rows(
    timestamps: Float[Tensor, " K"], times: Float[Tensor, " S"]
) -> tuple[Int[Tensor, " R"], Int[Tensor, " R"]]:
    """Return the displayed frames that have a pose, ascending, and the rows of their poses."""
    if len(timestamps) == 0 or len(times) == 0:
        nothing = torch.zeros(0, dtype=torch.int64, device="cpu")
        return nothing, nothing
    row, distance = nearest(times, timestamps)
    frame = torch.nonzero(distance < 1e-6)[:, 0]  # files keep nanoseconds
    return frame, row[frame]


def image_corners(camera: Camera) -> Float[Tensor, "4 3"]:
    """Return rays of unit depth through the image corners, in order around the image."""
    fx, fy, cx, cy = camera.params.double()[:4]
    x = (torch.tensor([0.0, 1, 1, 0], dtype=torch.float32, device="cpu") * (camera.width - 1) - cx) / fx
    y = (torch.tensor([0.0, 0, 1, 1], dtype=torch.float32, device="cpu") * (camera.height - 1) - cy) / fy
    slopes = torch.stack((x, y), dim=-1).clamp(-MAX_SLOPE, MAX_SLOPE)
    return torch.nn.functional.pad(slopes, (0, 1), value=1.0)


def of_points(
    slam_map: Map,
    point_ids: Int[Tensor, " P"],
    S_shown_map: Float[Tensor, "4 4"],
    session: int,
    size: tuple[int, int],
) -> dict[str, Any]:
    """Return what the ruler knows of each shown point: an image point of a session, and the error of its position.

    Returns:
        seen_frame, seen_pixel: (P,), (P, 2) as by `clearest_observations`, pixels in steps
        error_step, error_factor: (P,), (P, 6) as by `error_factors`; of the float32 of a step, the upper 16 bits
    """
    values: list[Any] = [[], [], [], []]
    if len(point_ids):  # else the table may have no columns yet
        rows = slam_map.keyframe_rows(session)
        frames, pixels = clearest_observations(slam_map, point_ids, rows, size)
        steps = STEPS / (torch.tensor(size, dtype=torch.float64, device="cpu") - 1).clamp(min=1)
        sR = S_shown_map[:3, :3]
        step, factor = error_factors(sR @ slam_map.points["covariances_w"][point_ids].double() @ sR.mT)
        upper = step.bfloat16().view(torch.int16).numpy().view(np.uint16)
        values = [frames, (pixels * steps).round().clamp(0, STEPS), upper, factor]
    names = {"seen_frame": "int32", "seen_pixel": "uint16", "error_step": "uint16", "error_factor": "int8"}
    return {name: numbers(each, kind) for (name, kind), each in zip(names.items(), values, strict=True)}


def clearest_observations(
    slam_map: Map, point_ids: Int[Tensor, " N"], keyframes: Int[Tensor, " K"], size: tuple[int, int]
) -> tuple[Int[Tensor, " N"], Float[Tensor, "N 2"]]:
    """Return one observation of each point by one of the keyframes: of a fine scale, and far from the border.

    Returns:
        Index of the frame in the sequence, -1 for points that none of them observes; and pixels.
    """
    seen = slam_map.observations(keyframes.to(slam_map.T_cw.device))
    half = torch.tensor(size, dtype=seen.pixels.dtype, device=seen.pixels.device) / 2
    off_center = ((seen.pixels + 0.5) / half - 1).square().sum(dim=-1) / 2  # 1 in the corners
    order = torch.argsort(seen.scales * (1 + off_center), stable=True)
    chosen = order[first_of_each(seen.point_index[order])]
    row = point_ids.new_full((len(slam_map.points),), NO_POINT)
    row[seen.point_index[chosen]] = chosen
    row = row[point_ids]
    known = row != NO_POINT
    frames, pixels = torch.full_like(row, -1), seen.pixels.new_zeros(len(row), 2)
    frames[known] = slam_map.keyframes["frame_index"][seen.keyframe_index[row[known]]]
    pixels[known] = seen.pixels[row[known]]
    return frames, pixels


def error_factors(covariances: Float[Tensor, "N 3 3"]) -> tuple[Float[Tensor, " N"], Int[Tensor, "N 6"]]:
    """Return covariances as numbers of steps, of their Cholesky factors L.

    Returns:
        Length of a step, 0 where the covariance is unknown; and the entries of L on and below the diagonal, row by row.
    """
    largest = covariances.diagonal(dim1=-2, dim2=-1).amax(dim=-1)
    known = (largest > 0) & covariances.isfinite().all(dim=-1).all(dim=-1)
    eye = torch.eye(3, dtype=covariances.dtype, device=covariances.device)
    scaled = torch.where(known[:, None, None], covariances / largest[:, None, None], eye)
    # A depth that is much less certain than the rest leaves rounding errors in the other directions.
    L, failed = torch.linalg.cholesky_ex(scaled + 1e-9 * eye)
    known = known & (failed == 0)
    steps = (L.clamp(-1, 1) * FACTOR_STEPS).round().to(torch.int64)
    low, column = torch.tril_indices(3, 3, device="cpu").unbind()
    length = torch.where(known, largest.clamp(min=0).sqrt() / FACTOR_STEPS, 0.0)
    return length, torch.where(known[:, None], steps[:, low, column], 0)


def numbers(values: Num[Tensor, "*shape"] | np.ndarray | list[Any], kind: str) -> np.ndarray:
    """Return numbers as an array of a type that the page knows."""
    return np.ascontiguousarray(np.asarray(values, dtype=kind))


def encoded(array: np.ndarray) -> dict[str, str]:
    """Encode an array as base64 of its little-endian numbers, row by row."""
    data = array.astype(array.dtype.newbyteorder("<")).tobytes()
    return {"type": array.dtype.name, "data": base64.b64encode(data).decode("ascii")}
