"""Corners of targets as points of a run's observation graph: their identity is exact, wherever the camera sees them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry import triangulate_many
from torchslam.metric.markers.detection import Detection
from torchslam.metric.markers.targets import Target, TargetKind
from torchslam.optim.run_graph import ObservationGraph, RunGraph

CORNER_STD_PX = 0.15
"""Standard deviation of a corner, pixels: .07 for sides of 60 px, .14 for 30 px in rendered images of little noise."""
MIN_ANGLE_DEG = 1.0
"""Least parallax of a corner: below, the size of a marker is unknown to a few percent."""
MAX_ERROR_PX = 5.0
"""Largest median reprojection error of a marker's corners in the poses of the run: else it moves, or appears twice."""
MIN_CORNERS = 3
"""Least corners of a target, so that its size is no single edge."""


@dataclass(frozen=True)
class Sighting:
    """A target in a frame.

    Attributes:
        frame: row of the graph.
        target: which of the user's targets.
        detection: where it is.
    """

    frame: int
    target: int
    detection: Detection


@dataclass(frozen=True)
class PlacedTarget:
    """A target whose corners are points of the graph.

    Attributes:
        name: in words.
        points: rows of its corners in the points of the graph.
        corners: their positions in the plane of the target, meters.
        observations: rows of the graph's observations.
        sides_px2: sum over the frames of the squared length of a side, pixels: its information.
        side_px: usual length of a side in the images, pixels.
    """

    name: str
    points: Int[Tensor, " C"]
    corners: Float[Tensor, "C 2"]
    observations: Int[Tensor, " O"]
    sides_px2: float
    side_px: float


@dataclass(frozen=True)
class GraphWithCorners:
    """An observation graph with the corners of targets as its last points.

    Attributes:
        graph: the whole.
        targets: those that have a place.
        dropped: one line for each target that has none.
    """

    graph: ObservationGraph
    targets: tuple[PlacedTarget, ...]
    dropped: tuple[str, ...]


def add_corners(
    graph: RunGraph, sightings: Iterable[Sighting], targets: Sequence[Target]
) -> GraphWithCorners:
    """Add the corners of all targets that two frames or more see from different places.

    Frames that see one of them become keyframes: their poses are found together with the corners.
    """
    groups: dict[tuple[int, int], list[Sighting]] = {}
    for sighting in sightings:
        groups.setdefault((sighting.target, sighting.detection.identity), []).append(sighting)
    placed, dropped, parts, count, seen = (
        list[PlacedTarget](),
        list[str](),
        list[_Part](),
        len(graph.points_w),
        0,
    )
    for (number, identity), group in sorted(groups.items()):
        target = targets[number]
        frames = [sighting.frame for sighting in group]
        if len(set(frames)) < len(frames):
            dropped.append(f"{target.name(identity)} appears twice: not used")
            continue
        if target.kind is TargetKind.CHESSBOARD:
            group = _from_one_end(graph, group)
        part, why = _place(graph, group, target, identity)
        if part is None:
            dropped.append(f"{target.name(identity)} {why}: not used")
            continue
        rows = torch.arange(len(part.corners), device=part.points_w.device) + count
        lengths = part.side_px
        own = torch.arange(len(part.pixels), device=rows.device) + len(graph.pixels) + seen
        placed.append(
            PlacedTarget(
                target.name(identity),
                rows,
                part.corners,
                own,
                float(lengths.square().sum()),
                float(lengths.median()),
            )
        )
        parts.append(part)
        count, seen = count + len(rows), seen + len(own)
    if not parts:
        return GraphWithCorners(graph, (), tuple(dropped))
    starts = [int(each.points[0]) for each in placed]
    pixels = torch.cat([part.pixels for part in parts])
    # Of weights only ratios count; those of keypoints are for twice their standard deviation (`KeypointNoise`).
    weight = (2 * CORNER_STD_PX) ** -2
    weights = graph.weights.new_full((len(pixels),), weight)
    if graph.weights.ndim == 3:
        weights = weights[:, None, None] * torch.eye(2, dtype=weights.dtype, device=weights.device)
    is_keyframe = graph.is_keyframe.clone()
    for part in parts:
        is_keyframe[part.frame_index] = True
    columns = {name: getattr(graph, name) for name in ObservationGraph.columns()}
    whole = ObservationGraph(camera=graph.camera, calibration=graph.calibration, **columns)
    points = [part.point_index + start for part, start in zip(parts, starts, strict=True)]
    return GraphWithCorners(
        replace(
            whole,
            points_w=torch.cat([graph.points_w, *(part.points_w for part in parts)]),
            frame_index=torch.cat([graph.frame_index, *(part.frame_index for part in parts)]),
            point_index=torch.cat([graph.point_index, *points]),
            pixels=torch.cat([graph.pixels, pixels]),
            weights=torch.cat([graph.weights, weights]),
            is_keyframe=is_keyframe,
        ),
        tuple(placed),
        tuple(dropped),
    )


@dataclass(frozen=True)
class _Part:
    """What a target adds to a graph; `point_index` counts from 0."""

    points_w: Float[Tensor, "C 3"]
    corners: Float[Tensor, "C 2"]
    frame_index: Int[Tensor, " O"]
    point_index: Int[Tensor, " O"]
    pixels: Float[Tensor, "O 2"]
    side_px: Float[Tensor, " F"]


def _from_one_end(graph: RunGraph, group: list[Sighting]) -> list[Sighting]:
    """Count the corners of a chessboard from the same end in all frames: the board does not mark the first one.

    From one sighting to the next in time, the direction from the first to the last corner changes by less than a right
    angle in the world.
    """
    group = sorted(group, key=lambda sighting: int(graph.frame_ids[sighting.frame]))
    turned, before_w = list[Sighting](), None
    for sighting in group:
        ends = torch.from_numpy(sighting.detection.pixels[[0, -1]]).to(graph.points_w)
        first, last = torch.nn.functional.normalize(graph.camera.unproject(ends), dim=-1)
        across_w = graph.T_cw[sighting.frame, :3, :3].mT @ (last - first)
        if before_w is not None and float(across_w @ before_w) < 0:
            detection = replace(sighting.detection, pixels=sighting.detection.pixels[::-1].copy())
            sighting, across_w = replace(sighting, detection=detection), -across_w
        turned.append(sighting)
        before_w = across_w
    return turned


def _place(graph: RunGraph, group: list[Sighting], target: Target, identity: int) -> tuple[_Part | None, str]:
    """Triangulate the corners of a target; or why that is impossible."""
    like = graph.points_w
    corners = torch.from_numpy(target.corners(identity)).to(like)
    frames = torch.tensor([sighting.frame for sighting in group], device=like.device)
    pixels = like.new_full((len(corners), len(group), 2), math.nan)
    for view, sighting in enumerate(group):
        rows = torch.from_numpy(sighting.detection.rows).to(like.device)
        pixels[rows, view] = torch.from_numpy(sighting.detection.pixels).to(like)
    mask = pixels.isfinite().all(dim=-1)
    if len(group) < 2:
        return None, "is seen by one frame only"
    found = triangulate_many(pixels, T_cw=graph.T_cw[frames], camera=graph.camera, mask=mask)
    good = found.mask & (found.angles >= math.radians(MIN_ANGLE_DEG))
    if int(good.sum()) < MIN_CORNERS:
        return None, "is seen from too few places"
    if float(found.errors[good][mask[good]].median()) > MAX_ERROR_PX:
        return None, "moves"
    corner, seen_in = torch.nonzero(mask[good], as_tuple=True)
    sides = _sides_px(pixels)
    return (
        _Part(
            found.points_w[good], corners[good], frames[seen_in], corner, pixels[good][corner, seen_in], sides
        ),
        "",
    )


def _sides_px(pixels: Float[Tensor, "C F 2"]) -> Float[Tensor, " F"]:
    """Size of a target in each frame, pixels: root mean square distance of its corners from their center, as a side."""
    seen = pixels.isfinite().all(dim=-1)
    spread = []
    for view in range(pixels.shape[1]):
        own = pixels[seen[:, view], view]
        spread.append((own - own.mean(dim=0)).square().sum(dim=-1).mean().sqrt())
    return math.sqrt(2.0) * torch.stack(spread)
