"""Many small graphs at once: as `graph.solve` of each, but by far fewer and larger operations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import Kernel
from torchslam.optim.bundle.api import BundleProblem, BundleSolution, bundle_adjust
from torchslam.optim.core.implicit import Backward
from torchslam.optim.run_graph import (
    GraphSolution,
    ObservationGraph,
    between,
    converged_of,
    join,
    keyframes_of,
    solve,
)

# A bundle adjustment is filled up to the largest of those it is solved with: none should be more than so many times as
# large as another.
_MOST_UNLIKE = 2.0


class _World(NamedTuple):
    """A world of a graph: rows of its keyframes and of its points there, and its bundle adjustment."""

    graph: int
    keyframes: Tensor
    points: Tensor
    problem: BundleProblem

    @property
    def cells(self) -> int:
        """How large it is where many are solved at once."""
        return len(self.problem.T_cw) * len(self.points)


@full_precision
def solve_each(
    graphs: Sequence[ObservationGraph],
    kernel: Kernel = "huber",
    scale: Tensor | float = 2.45,
    backward: Backward = "implicit",
    iterations: int = 30,
    tolerance: float = 1e-10,
) -> tuple[GraphSolution, ...]:
    """The minimum of every graph as `solve` finds it, up to rounding; options and errors as there.

    Graphs need not be of one size, nor see through one camera; those whose cameras have the same model, and whose
    weights are both numbers or both matrices, are solved together. What has converged leaves the batch, and one that
    fails does not touch the others.
    """
    alike: dict[tuple[object, ...], list[int]] = {}
    for row, graph in enumerate(graphs):
        kind = (graph.camera.model, graph.camera.params.dtype, graph.camera.params.device, graph.weights.ndim)
        alike.setdefault(kind, []).append(row)
    solved: dict[int, GraphSolution] = {}
    found: Sequence[GraphSolution]
    for rows in alike.values():
        if len(rows) == 1:
            found = (solve(graphs[rows[0]], kernel, scale, False, backward, iterations, tolerance),)
        else:
            some = [graphs[row] for row in rows]
            found = _solve_alike(some, kernel, scale, backward, iterations, tolerance)
        solved.update(zip(rows, found, strict=True))
    return tuple(solved[row] for row in range(len(graphs)))


def _solve_alike(
    graphs: Sequence[ObservationGraph],
    kernel: Kernel,
    scale: Tensor | float,
    backward: Backward,
    iterations: int,
    tolerance: float,
) -> tuple[GraphSolution, ...]:
    """Graphs whose cameras have one model, together."""
    options = kernel, scale, backward, iterations, tolerance
    worlds = [
        _World(number, *keyframes_of(graph, submap))
        for number, graph in enumerate(graphs)
        for submap in graph.submaps
    ]
    bundles = _bundles(worlds, *options)
    # Rows of all graphs, one after the other, as `join` has them; `submap` tells the graphs apart.
    joined = join([_plain(graph, number) for number, graph in enumerate(graphs)])
    frame_starts, point_starts = _starts([g.T_cw for g in graphs]), _starts([g.points_w for g in graphs])
    frames = torch.cat([submap.keyframes + frame_starts[submap.graph] for submap in worlds])
    points = torch.cat([submap.points + point_starts[submap.graph] for submap in worlds])
    if len(torch.unique(points)) < len(points):
        raise ValueError("a point is seen in two worlds")
    success, moved = torch.zeros_like(joined.is_keyframe), joined.points_w.new_zeros(len(joined.points_w))
    finite = joined.T_cw[frames].isfinite().flatten(1).all(-1)
    succeeded = torch.cat([bundle.success.expand(len(bundle.T_cw)) for bundle in bundles])
    T_cw = joined.T_cw.detach().index_copy(0, frames, torch.cat([bundle.T_cw for bundle in bundles]))
    points_w = torch.cat([bundle.points_w for bundle in bundles])
    points_w = joined.points_w.detach().index_copy(0, points, points_w)
    moved = moved.bool().index_copy(0, points, torch.cat([bundle.moved_points for bundle in bundles]))
    success = success.index_copy(0, frames, succeeded & finite)
    params = torch.stack([graph.camera.params for graph in graphs])
    camera = graphs[0].camera.with_params(params[joined.submap])
    T_cw, success, settled = between(joined, T_cw, points_w, camera, moved, success, *options)
    solutions = []
    for number, graph in enumerate(graphs):
        rows = slice(frame_starts[number], frame_starts[number] + len(graph.T_cw))
        places = slice(point_starts[number], point_starts[number] + len(graph.points_w))
        own = tuple(bundle for bundle, submap in zip(bundles, worlds, strict=True) if submap.graph == number)
        converged = settled[rows] & converged_of(graph, own)
        found = T_cw[rows], points_w[places], graph.camera, success[rows], moved[places], converged
        solutions.append(GraphSolution(graph.timestamps, *found, graph.submap, own))
    return tuple(solutions)


def _bundles(
    worlds: Sequence[_World],
    kernel: Kernel,
    scale: Tensor | float,
    backward: Backward,
    iterations: int,
    tolerance: float,
) -> list[BundleSolution]:
    """The bundle adjustment of each world, found together with those of like size."""
    found: dict[int, BundleSolution] = {}
    for rows in _of_like_size(worlds):
        problems = [worlds[row].problem for row in rows]
        together = bundle_adjust(_filled_up(problems), kernel, scale, False, backward, iterations, tolerance)
        for number, (row, problem) in enumerate(zip(rows, problems, strict=True)):
            found[row] = together.element(number, len(problem.T_cw), len(problem.points_w))
    return [found[row] for row in range(len(worlds))]


def _of_like_size(worlds: Sequence[_World]) -> list[list[int]]:
    """Rows of the worlds, in groups within which none is much larger than another."""
    groups: list[list[int]] = []
    for row in sorted(range(len(worlds)), key=lambda row: worlds[row].cells):
        least = worlds[groups[-1][0]].cells if groups else 0
        if groups and worlds[row].cells <= _MOST_UNLIKE * least:
            groups[-1].append(row)
        else:
            groups.append([row])
    return groups


def _filled_up(problems: Sequence[BundleProblem]) -> BundleProblem:
    """One batch of problems of different sizes, each with a camera of its own."""
    first = problems[0]
    T_cw, points_w, frame_index, point_index, pixels = (
        pad_sequence([getattr(problem, name) for problem in problems], batch_first=True)
        for name in ("T_cw", "points_w", "frame_index", "point_index", "pixels")
    )
    weights = [problem.weights for problem in problems if problem.weights is not None]
    counted = [torch.ones_like(problem.frame_index, dtype=torch.bool) for problem in problems]
    cameras = torch.stack([problem.camera.params for problem in problems])
    return BundleProblem(
        T_cw,
        points_w,
        frame_index,
        point_index,
        pixels,
        first.camera.with_params(cameras),
        pad_sequence(weights, batch_first=True),
        first.fixed_frames,
        mask=pad_sequence(counted, batch_first=True),
    )


def _plain(graph: ObservationGraph, number: int) -> ObservationGraph:
    """The columns that every graph has, all of one world, whose number is the graph's."""
    columns = {name: getattr(graph, name) for name in ObservationGraph.columns()}
    whole = ObservationGraph(camera=graph.camera, **columns)
    return replace(whole, submap=torch.full_like(graph.submap, number))


def _starts(tables: Sequence[Tensor]) -> list[int]:
    """In which row each of some tables begins where they stand one after the other."""
    return torch.tensor([0, *(len(table) for table in tables)]).cumsum(0).tolist()[:-1]
