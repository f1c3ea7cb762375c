"""Markers as a source of meters: their corners are points of the final adjustment, whose poses stay free.

Triangulated by the poses of a run, markers come out about 1 % too large, and their formal error is 5 to 14 times too
small. With the corners among the points, the error of a marker's size is that of the whole adjustment: the gradient of
the size with respect to every pixel of the graph carries the noise of each of them to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.errors import MeasurementError
from torchslam.geometry import Camera, SensorModel, se3_inverse, transform, triangulate_many
from torchslam.geometry.robust import NORMAL_SQUARED_MEDIAN_2D, median_scale, weighted_median
from torchslam.metric.markers.detection import (
    Detection,
    Detector,
    Target,
    TargetKind,
    detector_of,
    parse_target,
)
from torchslam.metric.meters import MAX_DISAGREEMENT
from torchslam.metric.options import Given
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView, Unmeasured
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.observation_graph import ObservationGraph, RunGraph
from torchslam.optim.run_graph import GraphSolution, solve_graph

MIN_VIEWS = 5
"""Keyframes that must see one marker; with fewer, the frames between them are searched as well."""
BIAS_PX = 0.05
"""Error of the length of a side that all images share, pixels: of the edges, of the print and of the lens. In rendered
images it is .01."""
LEAST_DEVIATION = 0.01
"""Relative deviation of a marker from the others from which on it may be rejected: less is no wrong size."""
CORNER_STD_PX = 0.15
"""Standard deviation of a corner, pixels: .07 for sides of 60 px, .14 for 30 px in rendered images of little noise."""
MIN_ANGLE_DEG = 1.0
"""Least parallax of a corner: below, the size of a marker is unknown to a few percent."""
MAX_ERROR_PX = 5.0
"""Largest median reprojection error of a marker's corners in the poses of the run: else it moves, or appears twice."""


def from_options(given: Given) -> list[Markers]:
    """The source of all `--marker`.

    Raises MeasurementError if a description is wrong, or a kind of marker is given twice.
    """
    targets = [parse_target(text) for (text,) in given["marker"]]
    for number, target in enumerate(targets):
        for other in targets[:number]:
            if target.kind is other.kind and target.family == other.family:
                raise MeasurementError(
                    f"--marker {other.text} and {target.text}: the same markers with two sizes; give those of single "
                    f"ids as {other.text.split(',')[0]},7=0.1"
                )
    return [Markers(targets)]


class Markers:
    """Markers and boards of known size in the images.

    The adjustment with their corners also improves the poses of the submap, which are kept.
    """

    def __init__(
        self, targets: Sequence[Target], make_detector: Callable[[Target, Camera], Detector] = detector_of
    ) -> None:
        """Take the targets, and what makes a detector of one of them; OpenCV's by default."""
        self._targets, self._make_detector = tuple(targets), make_detector

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """Measure the unit of a submap by the sizes of all markers that are seen in it."""
        if not view.has_images:
            return Unmeasured(ScaleSource.MARKER, "there are no images to find markers in")
        submap = view.submap
        graph = submap.posed_frames.graph(submap.map, SensorModel(view.camera, view.readout))
        detectors = [self._make_detector(target, view.camera) for target in self._targets]
        sightings = find_targets(graph, view, detectors)
        if not sightings:
            wanted = ", ".join(target.text.split(":")[0] for target in self._targets)
            return Unmeasured(ScaleSource.MARKER, f"no image shows a marker ({wanted})")
        with_corners = add_corners(graph, sightings, self._targets)
        if not with_corners.targets:
            return Unmeasured(ScaleSource.MARKER, "; ".join(with_corners.dropped))
        with torch.inference_mode(False), torch.enable_grad():
            pixels = with_corners.graph.pixels.detach().clone().requires_grad_()
            solution = solve_graph(replace(with_corners.graph, pixels=pixels), options=GRAPH_OPTIONS)
            if not bool(solution.keyframes[0].success):
                return Unmeasured(ScaleSource.MARKER, "the adjustment with the corners of the markers failed")
            measured = scale_of_targets(with_corners, solution, pixels)
        measured = replace(measured, stated=" ".join(target.text for target in self._targets))
        detached = replace(solution, T_cw=solution.T_cw.detach(), points_w=solution.points_w.detach())
        submap.posed_frames.apply_solution(detached, graph, submap.map)
        return measured


@dataclass(frozen=True)
class Sighting:
    """One of the user's targets in a frame, a row of the graph."""

    frame: int
    target: int
    detection: Detection


def find_targets(graph: RunGraph, view: SubmapView, detectors: Sequence[Detector]) -> list[Sighting]:
    """Find targets in the keyframes of a session, and in its other frames if few keyframes see them.

    They are in the order of time; an image that cannot be read shows none.
    """

    def search(frames: Bool[Tensor, " K"]) -> list[Sighting]:
        rows = torch.nonzero(frames & (graph.sessions == view.session))[:, 0]
        found = []
        for row in rows[torch.argsort(graph.frame_ids[rows])].tolist():
            image = view.gray(int(graph.frame_ids[row]))
            if image is not None:
                gray = (image * 255.0).round().astype("uint8")
                for number, detector in enumerate(detectors):
                    found += [Sighting(row, number, detection) for detection in detector.detect(gray)]
        return found

    sightings = search(graph.is_keyframe)
    if max(map(len, _by_target(sightings).values()), default=0) < MIN_VIEWS:
        sightings += search(~graph.is_keyframe)
    return sightings


def _by_target(sightings: Iterable[Sighting]) -> dict[tuple[int, int], list[Sighting]]:
    """The sightings of each target of the user with each identity."""
    groups: dict[tuple[int, int], list[Sighting]] = {}
    for each in sightings:
        groups.setdefault((each.target, each.detection.identity), []).append(each)
    return groups


@dataclass(frozen=True)
class PlacedTarget:
    """A target whose corners are points of the graph.

    Attributes:
        name: in words.
        points: rows of its corners in the points of the graph.
        corners: their positions in the plane of the target, meters.
        points_w: their positions by triangulation.
        frame_index, point_index, pixels: their observations.
        sides_px: length of a side in each frame; the sum of their squares is the information on its size.
    """

    name: str
    points: Int[Tensor, " C"]
    corners: Float[Tensor, "C 2"]
    points_w: Float[Tensor, "C 3"]
    frame_index: Int[Tensor, " O"]
    point_index: Int[Tensor, " O"]
    pixels: Float[Tensor, "O 2"]
    sides_px: Float[Tensor, " F"]


@dataclass(frozen=True)
class GraphWithCorners:
    """An observation graph with the corners of targets as its last points, and lines about those without a place."""

    graph: ObservationGraph
    targets: tuple[PlacedTarget, ...]
    dropped: tuple[str, ...]


def add_corners(
    graph: RunGraph, sightings: Iterable[Sighting], targets: Sequence[Target]
) -> GraphWithCorners:
    """Add the corners of all targets that two frames or more see from different places.

    Frames that see one of them become keyframes: their poses are found together with the corners.
    """
    placed, dropped, first = list[PlacedTarget](), list[str](), len(graph.points_w)
    for (number, identity), group in sorted(_by_target(sightings).items()):
        part = _place(graph, group, targets[number], identity, first)
        if isinstance(part, str):
            dropped.append(f"{targets[number].name(identity)} {part}: not used")
        else:
            placed.append(part)
            first += len(part.points)
    if not placed:
        return GraphWithCorners(graph, (), tuple(dropped))
    columns = {name: getattr(graph, name) for name in ObservationGraph.columns()}
    for name in ("points_w", "frame_index", "point_index", "pixels"):
        columns[name] = torch.cat([columns[name], *(getattr(part, name) for part in placed)])
    # Of weights only ratios count; those of keypoints are for twice their standard deviation (`KeypointNoise`).
    weight = graph.weights.new_tensor((2 * CORNER_STD_PX) ** -2)
    if graph.weights.ndim == 3:
        weight = weight * torch.eye(2, dtype=weight.dtype, device=weight.device)
    added = len(columns["pixels"]) - len(graph.pixels)
    columns["weights"] = torch.cat([graph.weights, weight.expand(added, *weight.shape)])
    seeing = torch.cat([part.frame_index for part in placed])
    columns["is_keyframe"] = graph.is_keyframe.index_fill(0, seeing, True)
    whole = ObservationGraph(camera=graph.camera, calibration=graph.calibration, **columns)
    return GraphWithCorners(whole, tuple(placed), tuple(dropped))


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


def _place(
    graph: RunGraph, group: list[Sighting], target: Target, identity: int, first: int
) -> PlacedTarget | str:
    """Triangulate the corners of a target, points of the graph from `first` on; or why that is impossible."""
    if len({sighting.frame for sighting in group}) < len(group):
        return "appears twice"
    if len(group) < 2:
        return "is seen by one frame only"
    if target.kind is TargetKind.CHESSBOARD:
        group = _from_one_end(graph, group)
    like = graph.points_w
    corners = torch.from_numpy(target.corners(identity)).to(like)
    frames = torch.tensor([sighting.frame for sighting in group], device=like.device)
    pixels = like.new_full((len(corners), len(group), 2), math.nan)
    for view, sighting in enumerate(group):
        rows = torch.from_numpy(sighting.detection.rows).to(like.device)
        pixels[rows, view] = torch.from_numpy(sighting.detection.pixels).to(like)
    mask = pixels.isfinite().all(dim=-1)
    found = triangulate_many(pixels, T_cw=graph.T_cw[frames], camera=graph.camera, mask=mask)
    good = found.mask & (found.angles >= math.radians(MIN_ANGLE_DEG))
    if int(good.sum()) < 3:  # its size would be a single edge
        return "is seen from too few places"
    if float(found.errors[good][mask[good]].median()) > MAX_ERROR_PX:
        return "moves"
    # The root mean square distance of the corners from their center in each frame, as a side.
    apart = pixels - pixels.nanmean(dim=0)
    sides_px = math.sqrt(2.0) * apart.square().sum(dim=-1).nanmean(dim=0).sqrt()
    corner, seen_in = torch.nonzero(mask[good], as_tuple=True)
    return PlacedTarget(
        target.name(identity),
        first + torch.arange(int(good.sum()), device=like.device),
        corners[good],
        found.points_w[good],
        frames[seen_in],
        first + corner,
        pixels[good][corner, seen_in],
        sides_px,
    )


def log_sizes(targets: Sequence[PlacedTarget], points_w: Float[Tensor, "N 3"]) -> Float[Tensor, " T"]:
    """Logarithms of the meters per unit by each target, differentiable in the points.

    Its size is the root mean square distance of its corners from their center.
    """
    logs = []
    for target in targets:
        both = (target.corners, points_w[target.points])
        true, found = ((corners - corners.mean(dim=0)).square().sum() for corners in both)
        logs.append(0.5 * (true.log() - found.log()))
    return torch.stack(logs)


@dataclass(frozen=True)
class _Sizes:
    """Logarithms of meters per unit by each target, differentiable, their relative information, and their errors."""

    logs: Float[Tensor, " T"]
    information: Float[Tensor, " T"]
    pixels: Float[Tensor, "O 2"]
    variances_px2: Float[Tensor, " O"]

    def mean(self, used: Bool[Tensor, " T"]) -> Float[Tensor, ""]:
        weights = torch.where(used, self.information, 0.0)
        return (weights * self.logs).sum() / weights.sum()

    def std(self, value: Float[Tensor, ""]) -> float:
        """Standard deviation of a function of the minimum, by the noise of all pixels."""
        (gradient,) = torch.autograd.grad(value, self.pixels, retain_graph=True)
        return math.sqrt(float((gradient.square() * self.variances_px2[:, None]).sum()))


def scale_of_targets(
    with_corners: GraphWithCorners, solution: GraphSolution, pixels: Float[Tensor, "O 2"]
) -> ScaleMeasurement:
    """The unit by all targets of an adjusted graph; a target that contradicts the others does not count and is listed.

    The solution is the minimum of the graph, differentiable in its pixels, the leaf of the gradient.
    """
    targets = with_corners.targets
    logs = log_sizes(targets, solution.points_w)
    information = torch.stack([target.sides_px.square().sum() for target in targets]).to(logs)
    sizes = _Sizes(logs, information, pixels, pixel_variances(with_corners, solution))
    used, lines = _agreeing(targets, sizes)
    mean, count = sizes.mean(used), int(used.sum())
    # A bundle adjustment leaves the unit open: what has an error is the length of the path in meters.
    centers_w = se3_inverse(solution.T_cw[with_corners.graph.is_keyframe])[:, :3, 3]
    path = 0.5 * (centers_w - centers_w.mean(dim=0)).square().sum().log()
    formal = sizes.std(mean + path)
    if count > 1:
        weights = information[used] / information[used].sum()
        apart = math.sqrt(float((weights * (logs - mean).detach()[used].square()).sum()))
        # The error of a mean whose weights are those of the information, by the spread of what it is the mean of.
        square = float(weights.square().sum())
        formal = max(formal, apart * math.sqrt(square / (1 - square)))
    else:
        # The distances between all corners of the one target.
        target = targets[int(used.nonzero())]
        points_w = solution.points_w.detach()[target.points]
        apart = float((torch.pdist(points_w) / torch.pdist(target.corners)).log().std())
    side_px = float(torch.stack([target.sides_px.median() for target in targets])[used].median())
    return ScaleMeasurement(
        ScaleSource.MARKER,
        math.exp(float(mean.detach())),
        math.hypot(formal, BIAS_PX / side_px),
        count,
        "markers" if count > 1 else "marker",
        (*lines, *with_corners.dropped),
        apart=apart,
    )


def _agreeing(targets: Sequence[PlacedTarget], sizes: _Sizes) -> tuple[Bool[Tensor, " T"], list[str]]:
    """The targets that agree with most of the others, and a line for each that does not.

    Of two that contradict each other none is right, and both count.
    """
    logs = sizes.logs.detach()
    used = torch.ones(len(targets), dtype=torch.bool, device=logs.device)
    lines = []
    while int(used.sum()) > 1:
        middle = weighted_median(logs[used], sizes.information[used])
        off = torch.where(used, (logs - middle).abs(), 0.0)
        row = int(off.argmax())
        others = used.clone()
        others[row] = False
        error = sizes.std(sizes.logs[row] - sizes.mean(others))
        error = math.hypot(error, BIAS_PX / float(targets[row].sides_px.median()))
        if float(off[row]) <= max(LEAST_DEVIATION, MAX_DISAGREEMENT * error):
            break
        deviation = math.expm1(float(sizes.mean(others).detach() - logs[row]))
        larger = "larger" if deviation > 0 else "smaller"
        off_by = f"{abs(deviation):.1%} ± {error:.1%} {larger}"
        size = f"{targets[row].name} is {off_by} than stated, by the size of"
        if int(used.sum()) == 2:
            lines.append(f"{size} {targets[int(others.nonzero())].name}: one of both is wrong")
            break
        lines.append(f"{size} the others: not used")
        used = others
    return used, lines


def pixel_variances(with_corners: GraphWithCorners, solution: GraphSolution) -> Float[Tensor, " O"]:
    """Variances of all pixels, px^2: by the stated weights, calibrated by the residuals of keypoints and of corners."""
    graph = with_corners.graph
    points_c = transform(
        solution.T_cw.detach()[graph.frame_index], solution.points_w.detach()[graph.point_index][:, None]
    )[:, 0]
    projected, seen = graph.camera.project(points_c)
    residuals = torch.where(seen[:, None], projected - graph.pixels, 0.0)
    weights = graph.weights
    if weights.ndim == 3:
        weights = 0.5 * weights.diagonal(dim1=1, dim2=2).sum(-1)
    squared = weights * residuals.square().sum(dim=-1)
    first = len(graph.pixels) - sum(len(target.pixels) for target in with_corners.targets)
    corners = sum(len(target.points) for target in with_corners.targets)
    variances = torch.empty_like(squared)
    for rows, unknowns in ((slice(0, first), 0), (slice(first, None), 3 * corners)):
        count = 2 * len(squared[rows])
        factor = median_scale(squared[rows], NORMAL_SQUARED_MEDIAN_2D) * count / max(count - unknowns, 1)
        variances[rows] = factor / weights[rows].clamp(min=1e-12)
    return variances
