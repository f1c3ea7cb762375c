"""The drift of a map in meters is corrected by what measures parts of its path, where that proves right.

A similarity brings a map into meters as a whole. Measurements of parts of the path say more, but a short path is known
better by the images than by a receiver. So the map is adjusted with four fifths of the measurements; where it then
explains the others better than the similarity alone does, it is adjusted with all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.metric.camera_path import CameraPath
from torchslam.metric.path_measurements import Keyframes, whole_path
from torchslam.metric.scale import ScaleMeasurement
from torchslam.metric.source import SubmapView
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.measurements import MeasuredLengths, MeasuredPositions, Measurement
from torchslam.optim.run_graph import POSE_ITERATIONS, GraphSolution, RunGraph, solve_graph

HELD_BACK = 5
"""One in so many measurements is held back to judge the correction by."""
LEAST_PARTS = 2 * HELD_BACK
"""Measurements of one source without which there are too few to hold any back."""
LEAST_GAIN = 3.0
"""Logarithm of the likelihood ratio of what was held back from which on a correction is believed."""
GAUGE_SHARE = 1e-4
"""Part of their information that measurements keep where they do not correct the map: they determine the unit and the
place, which images leave open, and the shape stays that of the images."""
OPTIONS = GRAPH_OPTIONS.replace(iterations=POSE_ITERATIONS, backward="detached")


class Correction(NamedTuple):
    """What measurements of a path have done to a map.

    Attributes:
        measurements: of the observation graph, whose minimum the map is.
        gain: logarithm of the likelihood ratio of what was held back; None where that was not tried.
        is_taken: whether the map was corrected.
    """

    measurements: tuple[Measurement, ...] = ()
    gain: float | None = None
    is_taken: bool = False


@torch.no_grad()
def correct_drift(
    view: SubmapView, measurements: Sequence[ScaleMeasurement], meters_per_unit: float
) -> Correction:
    """Adjust a submap with the measurements of parts of its path, if that explains what it was not given.

    Args:
        view: the submap, in meters.
        measurements: of its unit. The first one with a frame of its own has given the submap its world.
        meters_per_unit: of the submap as it was when they were made.
    """
    submap = view.submap
    keyframes = Keyframes.of(CameraPath.of(view), submap.map, view.session, meters_per_unit)
    framed = next((each for each in measurements if each.S_ew is not None), None)
    found, parts = list[Measurement](), list[Measurement]()
    for each in measurements:
        own = None
        # Positions are in the world of the source that has given the submap its frame.
        if each.parts is not None and (each.S_ew is None or each is framed):
            own = each.parts.on(keyframes)
        if own is not None and len(own.frames) >= LEAST_PARTS:
            parts.append(own)
        own = whole_path(keyframes, each.meters_per_unit, each.relative_std) if own is None else own
        if own is not None:
            found.append(own.weighed(view.observation_variance))
    gauge = Correction(tuple(each.weighed(GAUGE_SHARE) for each in found))
    if not parts:
        return gauge
    graph = submap.posed_frames.graph(submap.map, view.camera, readout=view.readout)
    trial = _solved(graph, [given_part(each).weighed(view.observation_variance) for each in parts])
    if trial is None:
        return gauge
    gain = sum(held_back_cost(each, graph.T_cw) - held_back_cost(each, trial.T_cw) for each in parts)
    if gain < LEAST_GAIN:
        return gauge._replace(gain=gain)
    solution = _solved(graph, found, trial)
    if solution is None:
        return gauge._replace(gain=gain)
    submap.posed_frames.apply_solution(solution, graph, submap.map)
    return Correction(tuple(found), gain, is_taken=True)


def _solved(
    graph: RunGraph, measurements: Sequence[Measurement], start: GraphSolution | None = None
) -> GraphSolution | None:
    """The minimum with measurements; None where they do not determine it."""
    graph = replace(graph, measurements=tuple(measurements))
    if start is not None:
        graph = replace(graph, T_cw=start.T_cw, points_w=start.points_w)
    solution = solve_graph(graph, options=OPTIONS)
    return solution if bool(solution.keyframes[0].success) else None


def held_back(count: int) -> Tensor:
    """Which of so many measurements are held back."""
    return torch.arange(count, device="cpu") % HELD_BACK == HELD_BACK // 2


def given_part(measured: Measurement) -> Measurement:
    """Measurements without those that are held back."""
    kept = ~held_back(len(measured.frames))
    if isinstance(measured, MeasuredLengths):
        return MeasuredLengths(measured.frames[kept], measured.lengths[kept], measured.information[kept])
    covariances = torch.linalg.inv(measured.information)[:, kept][..., kept]
    return MeasuredPositions(
        measured.frames[kept],
        measured.points_c[kept],
        measured.positions_w[kept],
        torch.linalg.inv(covariances),
    )


def held_back_cost(measured: Measurement, T_cw: Tensor) -> float:
    """Minus the logarithm of the likelihood of what is held back, given the rest, up to a constant."""
    return whitened_cost(measured, T_cw) - whitened_cost(given_part(measured), T_cw)


def whitened_cost(measured: Measurement, T_cw: Tensor) -> float:
    """Half of the whitened squared errors of measurements at poses."""
    errors = measured.errors(T_cw.to(measured.information))
    if isinstance(measured, MeasuredLengths):
        return 0.5 * float((measured.information * errors.square()).sum())
    return 0.5 * float(torch.einsum("na,anm,ma->", errors, measured.information, errors))
