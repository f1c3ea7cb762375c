"""Markers as a source of meters: their corners are points of the final adjustment, whose poses stay free.

Triangulated by the poses of a run, markers come out about 1 % too large, and their formal error is 5 to 14 times too
small. With the corners among the points, the error of a marker's size is that of the whole adjustment: the gradient of
the size with respect to every pixel of the graph carries the noise of each of them to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.errors import FrameError, MeasurementError
from torchslam.geometry import Camera, SensorModel, se3_inverse, transform
from torchslam.geometry.robust import NORMAL_SQUARED_MEDIAN_2D, median_scale, weighted_median
from torchslam.metric.markers.corners import GraphWithCorners, PlacedTarget, Sighting, add_corners
from torchslam.metric.markers.detection import Detector, detector_of
from torchslam.metric.markers.targets import Target, TargetKind, parse_target
from torchslam.metric.meters import MAX_DISAGREEMENT
from torchslam.metric.options import Given
from torchslam.metric.source import Images, ScaleMeasurement, ScaleSource, SubmapView, Unmeasured
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.run_graph import GraphSolution, RunGraph, solve_graph

MIN_VIEWS = 5
"""Keyframes that must see one marker; with fewer, the frames between them are searched as well."""
BIAS_PX = 0.05
"""Error of the length of a side that all images share, pixels: of the edges, of the print and of the lens. In rendered
images it is .01."""
LEAST_DEVIATION = 0.01
"""Relative deviation of a marker from the others from which on it may be rejected: less is no wrong size."""


def from_options(given: Given) -> list[Markers]:
    """The source of all `--marker`.

    Raises:
        MeasurementError: a description is wrong, or a kind of marker is given twice.
    """
    targets = [parse_target(text) for (text,) in given["marker"]]
    for number, target in enumerate(targets):
        for other in targets[:number]:
            same_family = target.kind is TargetKind.MARKER and target.family == other.family
            if same_family or (target.kind is not TargetKind.MARKER and target.kind is other.kind):
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
        self,
        targets: Sequence[Target],
        make_detector: Callable[[Target, Camera], Detector] = detector_of,
    ) -> None:
        """Take the targets, and what makes a detector of one of them; OpenCV's by default."""
        self._targets, self._make_detector = tuple(targets), make_detector

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """Measure the unit of a submap by the sizes of all markers that are seen in it."""
        if view.sequence is None or view.sequence.brings_features:
            return Unmeasured(ScaleSource.MARKER, "there are no images to find markers in")
        submap = view.submap
        graph = submap.posed_frames.graph(submap.map, SensorModel(view.camera, view.readout))
        detectors = [self._make_detector(target, view.camera) for target in self._targets]
        sightings = find_targets(graph, view.session, view.sequence, detectors)
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
        detached = replace(solution, T_cw=solution.T_cw.detach(), points_w=solution.points_w.detach())
        submap.posed_frames.apply_solution(detached, graph, submap.map)
        return measured


def find_targets(
    graph: RunGraph, session: int, images: Images, detectors: Sequence[Detector]
) -> list[Sighting]:
    """Find targets in the keyframes of a session, and in its other frames if few keyframes see them."""
    own = graph.sessions == session
    sightings = _search(graph, own & graph.is_keyframe, images, detectors)
    views: dict[tuple[int, int], int] = {}
    for each in sightings:
        key = each.target, each.detection.identity
        views[key] = views.get(key, 0) + 1
    if max(views.values(), default=0) < MIN_VIEWS:
        sightings += _search(graph, own & ~graph.is_keyframe, images, detectors)
    return sightings


def _search(
    graph: RunGraph, frames: Bool[Tensor, " K"], images: Images, detectors: Sequence[Detector]
) -> list[Sighting]:
    """The targets in some frames, in the order of time; an image that cannot be read shows none."""
    rows = torch.nonzero(frames)[:, 0]
    found = []
    for row in rows[torch.argsort(graph.frame_ids[rows])].tolist():
        try:
            image = images.image(int(graph.frame_ids[row]))
        except FrameError:
            continue
        gray = (image[0, 0] * 255.0).round().to(torch.uint8).cpu().numpy()
        for number, detector in enumerate(detectors):
            found += [Sighting(row, number, detection) for detection in detector.detect(gray)]
    return found


@dataclass(frozen=True)
class _Sizes:
    """Logarithms of meters per unit by each target, differentiable, and their relative information."""

    logs: Float[Tensor, " T"]
    information: Float[Tensor, " T"]

    def mean(self, used: Bool[Tensor, " T"]) -> Float[Tensor, ""]:
        weights = torch.where(used, self.information, 0.0)
        return (weights * self.logs).sum() / weights.sum()


def log_sizes(targets: Sequence[PlacedTarget], points_w: Float[Tensor, "N 3"]) -> Float[Tensor, " T"]:
    """Logarithms of the meters per unit by each target, differentiable in the points.

    Its size is the root mean square distance of its corners from their center.
    """
    logs = []
    for target in targets:
        corners_w = points_w[target.points]
        true, found = (
            (corners - corners.mean(dim=0)).square().sum() for corners in (target.corners, corners_w)
        )
        logs.append(0.5 * (true.log() - found.log()))
    return torch.stack(logs)


def scale_of_targets(
    with_corners: GraphWithCorners, solution: GraphSolution, pixels: Float[Tensor, "O 2"]
) -> ScaleMeasurement:
    """The unit by all targets of an adjusted graph; a target that contradicts the others does not count and is listed.

    Args:
        with_corners: the graph and its targets.
        solution: its minimum, differentiable in the pixels.
        pixels: of the graph, the leaf of the gradient.
    """
    targets = with_corners.targets
    logs = log_sizes(targets, solution.points_w)
    information = logs.new_tensor([target.sides_px2 for target in targets])
    sizes = _Sizes(logs, information)
    covariance_px2 = pixel_variances(with_corners, solution)

    def std(value: Float[Tensor, ""]) -> float:
        """Standard deviation of a function of the minimum, by the noise of all pixels."""
        (gradient,) = torch.autograd.grad(value, pixels, retain_graph=True)
        return math.sqrt(float((gradient.square() * covariance_px2[:, None]).sum()))

    used, lines = _agreeing(targets, sizes, std)
    mean = sizes.mean(used)
    # A bundle adjustment leaves the unit open: what has an error is the length of the path in meters.
    centers_w = se3_inverse(solution.T_cw[with_corners.graph.is_keyframe])[:, :3, 3]
    path = 0.5 * (centers_w - centers_w.mean(dim=0)).square().sum().log()
    deviations = (logs - mean).detach()[used]
    weights = information[used] / information[used].sum()
    side_px = float(
        torch.tensor([t.side_px for t in targets], dtype=torch.float64, device="cpu")[used.cpu()].median()
    )
    formal = std(mean + path)
    if len(deviations) > 1:
        apart = math.sqrt(float((weights * deviations.square()).sum()))
        # The error of a mean whose weights are those of the information, by the spread of what it is the mean of.
        spread = apart * math.sqrt(float(weights.square().sum()) / (1 - float(weights.square().sum())))
        formal = max(formal, spread)
    else:
        (row,) = torch.nonzero(used)[:, 0].tolist()
        apart = _edges_apart(targets[row], solution.points_w.detach())
    return ScaleMeasurement(
        ScaleSource.MARKER,
        math.exp(float(mean.detach())),
        math.hypot(formal, BIAS_PX / side_px),
        int(used.sum()),
        "markers" if int(used.sum()) > 1 else "marker",
        (*lines, *with_corners.dropped),
        apart=apart,
    )


def _agreeing(
    targets: Sequence[PlacedTarget], sizes: _Sizes, std: Callable[[Float[Tensor, ""]], float]
) -> tuple[Bool[Tensor, " T"], list[str]]:
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
        error = std(sizes.logs[row] - sizes.mean(others))
        error = math.hypot(error, BIAS_PX / targets[row].side_px)
        if float(off[row]) <= max(LEAST_DEVIATION, MAX_DISAGREEMENT * error):
            break
        deviation = math.expm1(float(sizes.mean(others).detach() - logs[row]))
        larger = "larger" if deviation > 0 else "smaller"
        size = (
            f"{targets[row].name} is {abs(deviation):.1%} ± {error:.1%} {larger} than stated, by the size of"
        )
        if int(used.sum()) == 2:
            lines.append(f"{size} {targets[int(torch.nonzero(others)[0])].name}: one of both is wrong")
            break
        lines.append(f"{size} the others: not used")
        used[row] = False
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
    first = len(graph.pixels) - sum(len(target.observations) for target in with_corners.targets)
    corners = sum(len(target.points) for target in with_corners.targets)
    variances = torch.empty_like(squared)
    for rows, unknowns in ((slice(0, first), 0), (slice(first, None), 3 * corners)):
        count = 2 * len(squared[rows])
        factor = median_scale(squared[rows], NORMAL_SQUARED_MEDIAN_2D) * count / max(count - unknowns, 1)
        variances[rows] = factor / weights[rows].clamp(min=1e-12)
    return variances


def _edges_apart(target: PlacedTarget, points_w: Float[Tensor, "N 3"]) -> float:
    """Relative standard deviation of the distances between all corners of one target."""
    true, found = (torch.pdist(corners) for corners in (target.corners, points_w[target.points]))
    return float((found / true).log().std())
