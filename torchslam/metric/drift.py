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
from jaxtyping import Float
from torch import Tensor

from torchslam.map.map import Map
from torchslam.metric.camera_path import CameraPath
from torchslam.metric.path_measurements import Keyframes, whole_path
from torchslam.metric.scale import ScaleMeasurement
from torchslam.metric.source import SubmapView
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.measurements import Measurement
from torchslam.optim.run_graph import POSE_ITERATIONS, GraphSolution, RunGraph, solve_graph

HELD_BACK = 5
"""One in so many measurements is held back to judge the correction by."""
LEAST_PARTS = 2 * HELD_BACK
"""Measurements of one source without which there are too few to hold any back."""
LEAST_GAIN = 3.0
"""Logarithm of the likelihood ratio of what was held back from which on a correction is believed."""
GAUGE_SHARE = 1e-2
"""Part of their information that measurements keep where they do not correct the map: they determine the unit and the
place, which images leave open, and the shape stays that of the images, to 3e-5 in a simulated street. With less, from
1e-3 on, solvers need more than 200 iterations to find the unit."""
GATE = 4.0
"""Standard deviations from the corrected path from which on a measurement is wrong."""
SOFT_ROUNDS = 2
"""Corrections in which a measurement counts the less the farther it is from the one before (weights of Cauchy): what is
wrong for a while would bend the path toward itself."""
ROUNDS = 3
"""Corrections after these, each without the measurements that are wrong by the one before."""
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
    submap, factor = view.submap, view.observation_variance
    keyframes = Keyframes.of(CameraPath.of(view), submap.map, view.session, meters_per_unit)
    framed = next((each for each in measurements if each.S_ew is not None), None)
    parts, others = list[Measurement](), list[Measurement]()
    for each in measurements:
        own: Measurement | None = None
        # Positions are in the world of the source that has given the submap its frame.
        if each.parts is not None and (each.S_ew is None or each is framed):
            own = each.parts.on(keyframes)
        own = whole_path(keyframes, each.meters_per_unit, each.relative_std) if own is None else own
        if own is not None:
            own = own.to(submap.map.T_cw)
            (parts if len(own.frames) >= LEAST_PARTS else others).append(own)
    gauge = tuple(_near(each, submap.map.T_cw).weighed(GAUGE_SHARE * factor) for each in (*parts, *others))
    if not parts:
        return Correction(gauge)
    graph = submap.posed_frames.graph(submap.map, view.camera, readout=view.readout)
    parts, trial = _trial(graph, parts, others, factor)
    if trial is None:
        return Correction(gauge)
    gain = float(sum(held_back_cost(each, graph.T_cw) - held_back_cost(each, trial.T_cw) for each in parts))
    if gain < LEAST_GAIN:
        return Correction(gauge, gain)
    found = tuple(each.weighed(factor) for each in (*parts, *others))
    before = _move(submap.map, graph, trial)
    # The frames between keyframes have followed theirs: from where they were they would not find their poses.
    graph = submap.posed_frames.graph(submap.map, view.camera, readout=view.readout)
    solution = _solved(graph, found)
    if solution is None:
        submap.map.keyframes["T_cw"][:], submap.map.points["positions_w"][:] = before
        return Correction(gauge, gain)
    submap.posed_frames.apply_solution(solution, graph, submap.map)
    return Correction(found, gain, is_taken=True)


def _near(measured: Measurement, T_cw: Float[Tensor, "K 4 4"]) -> Measurement:
    """Measurements that agree with poses; all where most do not, as where their noise is not known."""
    near = measured.deviations(T_cw) <= GATE
    return measured.select(near) if 2 * int(near.sum()) > len(near) else measured


def _move(slam_map: Map, graph: RunGraph, solution: GraphSolution) -> tuple[Tensor, Tensor]:
    """Move keyframes and points to a solution, and return where all of them were."""
    T_cw, positions_w = slam_map.keyframes["T_cw"], slam_map.points["positions_w"]
    before = T_cw.clone(), positions_w.clone()
    T_cw[:] = solution.T_cw[: slam_map.num_keyframes]
    positions_w[graph.point_ids] = solution.points_w
    return before


def _trial(
    graph: RunGraph, parts: list[Measurement], others: Sequence[Measurement], factor: float
) -> tuple[list[Measurement], GraphSolution | None]:
    """The minimum with all but what is held back, and the parts that agree with it, held back or not.

    It is None where it is not determined, or where too few of the parts agree.
    """
    solution: GraphSolution | None = None
    counts = [len(each.frames) for each in parts]
    for number in range(SOFT_ROUNDS + ROUNDS):
        given = [given_part(each) for each in parts]
        if number < SOFT_ROUNDS:
            T_cw = graph.T_cw if solution is None else solution.T_cw
            given = [each.softened(T_cw) for each in given]
        solution = _solved(graph, [each.weighed(factor) for each in (*given, *others)], solution)
        if solution is None:
            return parts, None
        if number + 1 < SOFT_ROUNDS:
            continue
        agreeing = [each.deviations(solution.T_cw) <= GATE for each in parts]
        if number >= SOFT_ROUNDS and all(bool(kept.all()) for kept in agreeing):
            break
        parts = [each.select(kept) for each, kept in zip(parts, agreeing, strict=True)]
        if any(
            len(each.frames) < max(LEAST_PARTS, count / 2) for each, count in zip(parts, counts, strict=True)
        ):
            return parts, None
    return parts, solution


def _solved(
    graph: RunGraph, measurements: Sequence[Measurement], start: GraphSolution | None = None
) -> GraphSolution | None:
    """The minimum with measurements; None where they do not determine it."""
    graph = replace(graph, measurements=tuple(measurements))
    if start is not None:
        graph = replace(graph, T_cw=start.T_cw, points_w=start.points_w)
    solution = solve_graph(graph, options=OPTIONS)
    return solution if bool(solution.keyframes[0].success) else None


def given_part(measured: Measurement) -> Measurement:
    """Measurements without those that are held back."""
    rows = torch.arange(len(measured.frames), device=measured.frames.device)
    return measured.select(rows % HELD_BACK != HELD_BACK // 2)


def held_back_cost(measured: Measurement, T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, ""]:
    """Minus the logarithm of the likelihood of what is held back, given the rest, up to a constant."""
    return measured.cost(T_cw) - given_part(measured).cost(T_cw)
