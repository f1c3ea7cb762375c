"""The observation graph of a run as one differentiable least-squares problem: its minimum is differentiated.

The trajectory of a finished run minimizes the reprojection errors of its observation graph. However many frames
and discrete choices led there, its gradient with respect to every pixel, weight and camera parameter is that of the
minimizer: one linear solve for the keyframes and the points, one small one for each frame in between.

With a rolling shutter, rounds of two steps follow each other: the keypoints are moved to where the middle row would
have seen them, by the present poses, points and camera, and the graph of a global shutter is solved. The rounds settle
quickly, since poses hardly change the motion between them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchslam.geometry import Camera, se3_inverse
from torchslam.geometry.precision import (
    full_precision,
    in_widest_precision,
)
from torchslam.optim._core.levenberg_marquardt import (
    GRAPH_OPTIONS,
    Convergence,
    Outcome,
    Progress,
    SolverOptions,
    check_minimum,
    part_of_a_solver,
    warned,
)
from torchslam.optim.bundle._factors import DepthPrior, Factors
from torchslam.optim.bundle._problem import BundleProblem
from torchslam.optim.bundle._solve import BundleSolution, solve_bundle
from torchslam.optim.observation_graph import (
    Graph,
    ObservationGraph,
    camera_prior,
    check_submaps,
    concatenate_graphs,
    first_rows,
    keyframe_problem,
    row_places,
)
from torchslam.optim.pose import solve_pose
from torchslam.types import Trajectory
from torchslam.utils.memory import available_memory

MAX_ROUNDS, SETTLED_PX = 12, 2e-3
"""Most rounds with a rolling shutter, and the change of the keypoints, as a root mean square, that ends them. A round
leaves a tenth to a third of the change of the one before."""
FIRST_TOLERANCE = 1e-6
"""Tolerance of the first of these rounds: with that of the last it takes as long as all others. Tried at this value
only."""
GRADIENT_ROUNDS = 8
"""Rounds with a rolling shutter that gradients pass: each leaves a tenth to a third of the gradient's error."""


BYTES_OF_KEYFRAMES, BYTES_BETWEEN = 2000, 300
"""Memory of a solution and its gradient for an observation of a keyframe, and of another frame. A walk of 5,000 frames,
296,000 and 1,179,000 observations, takes .71 GB."""


@dataclass(frozen=True)
class GraphSolution(Outcome):
    """The minimum of a graph, differentiable with respect to its pixels, weights and camera.

    It can be pickled, without gradients. Backward through frames that have not converged warns once.

    Attributes:
        T_cw: world to camera.
        camera: of all frames, with refined parameters where it was free.
        success: A frame that its observations do not determine stays at its start, without gradient. If the
            keyframes of a submap together are not determined, none of them succeeds.
        moved_points: Points that too few keyframes see stay at their start; their observations do not count.
        convergence: of the search for each frame's pose, or of its submap's keyframes and points, whose costs are of
            all together. A frame has `converged` where both ended at a minimum. Elsewhere the poses are nearly right,
            but the gradient may be wrong by any factor; `reasons` has why.
        submap: submap of each frame; different submaps share no coordinate frame.
        keyframes: the bundle adjustment of each submap, in the order of `ObservationGraph.submaps`, with its
            covariances; its rows are the submap's keyframes, with other frames of factors, and the points that its
            frames see.
    """

    timestamps: Float[Tensor, " K"]
    T_cw: Float[Tensor, "K 4 4"]
    points_w: Float[Tensor, "N 3"]
    camera: Camera
    success: Bool[Tensor, " K"]
    moved_points: Bool[Tensor, " N"]
    convergence: Convergence
    submap: Int[Tensor, " K"]
    keyframes: tuple[BundleSolution, ...]

    @property
    def trajectory(self) -> Trajectory:
        """Camera to submap, ordered by time, differentiable; of the submap with most frames."""
        submaps, frames = torch.unique(self.submap, return_counts=True)
        return self.trajectory_in(int(submaps[frames.argmax()]))

    def trajectory_in(self, submap: int) -> Trajectory:
        """Camera to submap, ordered by time, differentiable; of one submap."""
        rows = (self.submap == submap).nonzero().squeeze(-1)
        order = rows[torch.argsort(self.timestamps[rows], stable=True)]
        return Trajectory(self.timestamps[order], se3_inverse(self.T_cw[order]))


@in_widest_precision
@full_precision
def solve_graph(
    graph: ObservationGraph,
    *,
    free_camera: bool | Float[Tensor, "P n"] | None = None,
    options: SolverOptions = GRAPH_OPTIONS,
    progress: Progress | None = None,
    factors: Sequence[Factors] = (),
    depth_prior: DepthPrior | None = None,
    start: GraphSolution | None = None,
) -> GraphSolution:
    """Minimize the robust reprojection errors of a run's graph: keyframes and points, then the other frames.

    Every submap is solved on its own. Its first keyframe and its scale stay those of the start, unless
    `factors` or `depth_prior` determine the scale; a loss should not depend on them (aligned trajectory errors do
    not). With factors of a single frame or point, which are relative to the world, no keyframe is fixed. A camera that
    is free is found in the submap with most keyframes; the others are solved with it.

    With `graph.readout`, the minimum is that of the keypoints that its own poses, points and camera correct. The
    implicit gradient passes `GRADIENT_ROUNDS` rounds of correction and solution there, and is right to 1e-5; it also
    reaches `graph.readout.seconds`, which stays as it is.

    Args:
        graph: observation graph, as `Run.graph`.
        free_camera: as in `solve_bundle`. None: along the directions of `graph.calibration`, with it as a prior; the
            camera is fixed where there is none.
        options: how to minimize; gradients reach pixels, weights and camera, or the calibration where that is a prior.
        progress: called before each iteration of a bundle adjustment.
        factors: measured motions, heights, planes, lengths and the like, or custom residuals, with rows of the
            graph's frames and points, each of one submap. Their frames are solved together with the keyframes.
        depth_prior: depths of the observations. Those of frames that are not keyframes do not count.
        start: the solution of a graph like this one, before a step of a training, from which poses, points and a free
            camera start.

    Returns:
        The minimum, differentiable with respect to pixels, weights and camera, depths and what was measured.

    Raises:
        ValueError: a submap has no keyframe, two submaps see the same point, or a factor joins two submaps.
        ConvergenceError: with `options.strict`.
        MemoryError: the graph needs more memory than there is; solve parts of it, `ObservationGraph.window`.
    """
    strict, options = options.strict, options.replace(strict=False)
    _check_memory(graph)
    graph = _with_frames_of_factors(graph, factors)

    free, prior = (False, None) if free_camera is None else (free_camera, None)
    if free_camera is None and graph.calibration is not None:
        free, prior = graph.calibration.directions, camera_prior(graph.calibration)
    if start is not None:
        graph = _started(graph, start, free)

    def solved(graph: ObservationGraph, options: SolverOptions) -> GraphSolution:
        """The minimum of a graph whose keypoints are those of a global shutter."""

        def adjust(submaps: Sequence[_GraphSubmap]) -> list[BundleSolution]:
            solve = partial(solve_bundle, options=options, progress=progress, near=start is not None)
            main = max(range(len(submaps)), key=lambda row: len(submaps[row].keyframes))
            problems = [_with_factors(submap, graph, factors, depth_prior) for submap in submaps]
            first = solve(replace(problems[main], camera_prior=prior), free_camera=free)
            return [
                first if row == main else solve(replace(problem, camera=first.camera))
                for row, problem in enumerate(problems)
            ]

        return _solve([graph], adjust, options)[0]

    with part_of_a_solver():
        solution = (
            solved(graph, options) if graph.readout is None else _solve_in_rounds(graph, solved, options)
        )
    if strict:
        check_minimum(solution.success, solution.converged, "frames")
    return _warning(solution)


def _check_memory(graph: ObservationGraph) -> None:
    """Raises MemoryError where a graph on the CPU is too large for this machine."""
    of_keyframes = int(graph.is_keyframe[graph.frame_index].sum())
    needed = BYTES_OF_KEYFRAMES * of_keyframes + BYTES_BETWEEN * (len(graph.pixels) - of_keyframes)
    available = available_memory() if graph.pixels.device.type == "cpu" else None
    if available is not None and needed > available:
        raise MemoryError(
            f"a graph of {len(graph.pixels)} observations needs about {needed / 1e9:.1f} GB, and "
            f"{available / 1e9:.1f} GB are available: solve windows of it, graph.window(first, last) in seconds"
        )


def _warning(solution: GraphSolution) -> GraphSolution:
    """The solution, which warns of the gradient of frames that have not converged."""
    return replace(solution, T_cw=warned(solution.T_cw, solution.success, solution.convergence, "frames"))


def _started(graph: ObservationGraph, start: GraphSolution, free: bool | Tensor) -> ObservationGraph:
    """The graph with the poses, points and what is free of the camera of a solution."""
    for name in ("T_cw", "points_w"):
        own, given = getattr(graph, name), getattr(start, name)
        if own.shape != given.shape:
            raise ValueError(
                f"start.{name} must be {tuple(own.shape)} as of the graph, not {tuple(given.shape)}"
            )
    params, change = graph.camera.params, start.camera.params.detach() - graph.camera.params.detach()
    if isinstance(free, Tensor):
        change = free.detach() @ (torch.linalg.pinv(free.detach()) @ change)
    if free is not False:
        params = params + change
    T_cw, points_w = start.T_cw.detach().to(graph.T_cw), start.points_w.detach().to(graph.points_w)
    return replace(graph, T_cw=T_cw, points_w=points_w, camera=graph.camera.with_params(params))


def _solve_in_rounds(
    graph: ObservationGraph,
    solved: Callable[[ObservationGraph, SolverOptions], GraphSolution],
    options: SolverOptions,
) -> GraphSolution:
    """Correct the keypoints of a rolling shutter and solve the graph of a global one, until they stay where they are.

    With gradients, the number of rounds is fixed. Without, the first round ends at `FIRST_TOLERANCE`.
    """
    at, before = graph, graph.pixels
    passes_gradient = options.backward != "detached"
    rough = options.replace(tolerance=max(options.tolerance, FIRST_TOLERANCE))
    for number in range(GRADIENT_ROUNDS if passes_gradient else MAX_ROUNDS):
        corrected = at.global_shutter()
        is_rough = number == 0 and not passes_gradient and rough != options
        solution = solved(corrected, rough if is_rough else options)
        at = replace(at, T_cw=solution.T_cw, points_w=solution.points_w, camera=solution.camera)
        change = (corrected.pixels - before).detach().square().sum(-1).mean().sqrt()
        if not passes_gradient and not is_rough and bool(change < SETTLED_PX):
            break
        before = corrected.pixels
    return solution


def _with_frames_of_factors(graph: Graph, factors: Sequence[Factors]) -> Graph:
    """The graph with the frames that factors touch as keyframes. Raises ValueError where a factor joins two submaps, or
    a row is out of range."""
    is_keyframe, submaps = graph.is_keyframe, graph.submap
    of_points = submaps.new_zeros(len(graph.points_w))
    of_points = of_points.index_copy(0, graph.point_index, submaps[graph.frame_index])
    for each in factors:
        points = each.frames[:, :0] if each.points is None else each.points
        for name, rows, count in (
            ("frames", each.frames, len(submaps)),
            ("points", points, len(graph.points_w)),
        ):
            if rows.numel() and not 0 <= int(rows.min()) <= int(rows.max()) < count:
                raise ValueError(f"{name} of factors must lie in 0 ... {count - 1}")
        joined = torch.cat((submaps[each.frames], of_points[points]), dim=1)
        if bool((joined != joined[:, :1]).any()):
            raise ValueError("factors must join frames and points of one submap")
        is_keyframe = is_keyframe.index_fill(0, each.frames.flatten(), True)
    return replace(graph, is_keyframe=is_keyframe)


def _with_factors(
    submap: _GraphSubmap,
    graph: ObservationGraph,
    factors: Sequence[Factors],
    depth_prior: DepthPrior | None,
) -> BundleProblem:
    """The bundle adjustment of a submap with its share of the factors and depths of its graph."""
    slots, own = row_places(submap.keyframes, len(graph.T_cw)), []
    of_points = row_places(submap.points, len(graph.points_w))
    for each in factors:
        points = each.frames[:, :0] if each.points is None else each.points
        frames, points = slots[each.frames], of_points[points]
        rows = (torch.cat((frames, points), dim=1) >= 0).all(1).nonzero().squeeze(-1)
        given = each.measured[rows], each.information[rows], each.error, points[rows], each.of_camera
        own.append(Factors(frames[rows], *given))
    if depth_prior is not None:
        depth_prior = DepthPrior(depth_prior.depths[submap.rows], depth_prior.information[submap.rows])
    problem = replace(submap.problem, factors=tuple(own), depth_prior=depth_prior)
    is_placed = any(len(each.measured) and each.is_of_world for each in own)
    return replace(problem, fixed_frames=()) if is_placed else problem


def _pose_other_frames(
    graph: ObservationGraph,
    T_cw: Tensor,
    points_w: Tensor,
    camera: Camera,
    moved: Tensor,
    success: Tensor,
    convergence: Convergence,
    options: SolverOptions,
) -> tuple[Tensor, Tensor, Convergence]:
    """The poses, with frames that are not keyframes refined against the points, `success` and convergence, given those
    of the keyframes, for the others those of their submaps; camera: one for all frames or one of each, (K, P)."""
    others = (~graph.is_keyframe).nonzero().squeeze(-1)
    in_rank = torch.argsort(graph.frame_index, stable=True)
    counts = torch.bincount(graph.frame_index, minlength=len(graph.T_cw))
    starts, of_submaps = counts.cumsum(0) - counts, convergence.converged
    for frames in others.split(64) if len(others) else ():  # in batches, which bounds the memory
        slot = torch.arange(int(counts[frames].max()), device=frames.device)
        mask = slot < counts[frames, None]
        seen = in_rank[torch.where(mask, starts[frames, None] + slot, 0)]
        mask = mask & moved[graph.point_index[seen]]
        refined = solve_pose(
            points_w[graph.point_index[seen]],
            graph.pixels[seen],
            T_cw=graph.T_cw[frames],
            camera=camera if camera.params.ndim == 1 else camera[frames],
            weights=graph.weights[seen],
            mask=mask,
            options=options,
        )
        T_cw = T_cw.index_copy(0, frames, refined.T_cw)
        success = success.index_copy(0, frames, refined.success)
        ends = of_submaps[frames]  # where that of the submap did not end at a minimum, this is why
        own = [
            torch.where(ends, found, given[frames])
            for found, given in zip(refined.convergence.tensors, convergence.tensors, strict=True)
        ]
        copied = (x.index_copy(0, frames, y) for x, y in zip(convergence.tensors, own, strict=True))
        convergence = Convergence(*copied, limit=options.iterations)
    return T_cw, success, convergence


class _GraphSubmap(NamedTuple):
    """A submap of a graph: rows of its keyframes, points and observations there, and its bundle adjustment."""

    graph: int
    keyframes: Tensor
    points: Tensor
    rows: Tensor
    problem: BundleProblem


@full_precision
def solve_graphs(
    graphs: Sequence[ObservationGraph], *, options: SolverOptions = GRAPH_OPTIONS
) -> tuple[GraphSolution, ...]:
    """The minimum of every graph as `solve_graph` finds it, up to rounding; options and errors as there.

    Graphs may differ in size and camera. Those with an exact camera of one model, and the same kind of weights, are
    solved together. Converged problems leave the batch, and a failure does not affect the others.
    """
    strict, options = options.strict, options.replace(strict=False)
    one_precision = in_widest_precision(lambda graph: graph)
    graphs = [one_precision(graph) for graph in graphs]

    alike: dict[tuple[object, ...], list[int]] = {}
    for row, graph in enumerate(graphs):
        params = graph.camera.params
        kind: tuple[object, ...] = graph.camera.model, params.dtype, params.device, graph.weights.ndim
        if graph.calibration is not None or graph.readout is not None:
            kind = (row,)  # directions or rounds of its own
        alike.setdefault(kind, []).append(row)
    solved: dict[int, GraphSolution] = {}
    found: Sequence[GraphSolution]
    for rows in alike.values():
        if len(rows) == 1:
            found = (solve_graph(graphs[rows[0]], options=options),)
        else:
            with part_of_a_solver():
                found = _solve(
                    [graphs[row] for row in rows], partial(_adjust_together, options=options), options
                )
            found = [_warning(each) for each in found]
        solved.update(zip(rows, found, strict=True))
    solutions = tuple(solved[row] for row in range(len(graphs)))
    if strict and solutions:
        success = torch.cat([each.success for each in solutions])
        check_minimum(success, torch.cat([each.converged for each in solutions]), "frames")
    return solutions


def _solve(
    graphs: Sequence[ObservationGraph],
    adjust: Callable[[Sequence[_GraphSubmap]], list[BundleSolution]],
    options: SolverOptions,
) -> tuple[GraphSolution, ...]:
    """Solve graphs with one camera model; `adjust` solves the bundle adjustments of all their submaps."""
    for graph in graphs:
        check_submaps(graph)
    submaps = [
        _GraphSubmap(number, *keyframe_problem(graph, submap))
        for number, graph in enumerate(graphs)
        for submap in graph.submaps
    ]
    bundles = adjust(submaps)
    # Rows of all graphs, one after the other, as `concatenate_graphs` has them; `submap` distinguishes the graphs.
    joined = concatenate_graphs([_plain(graph, number) for number, graph in enumerate(graphs)])
    frame_starts, point_starts = (
        first_rows([g.T_cw for g in graphs]),
        first_rows([g.points_w for g in graphs]),
    )
    frames = torch.cat([submap.keyframes + frame_starts[submap.graph] for submap in submaps])
    points = torch.cat([submap.points + point_starts[submap.graph] for submap in submaps])

    T_cw = joined.T_cw.detach().index_copy(0, frames, torch.cat([bundle.T_cw for bundle in bundles]))
    success = torch.cat([bundle.success.expand(len(bundle.T_cw)) for bundle in bundles])
    success = joined.is_keyframe.index_copy(0, frames, success)
    success = success & joined.T_cw.isfinite().flatten(1).all(-1)
    points_w = torch.cat([bundle.points_w for bundle in bundles])
    points_w = joined.points_w.detach().index_copy(0, points, points_w)
    moved = joined.points_w.new_zeros(len(joined.points_w)).bool()
    moved = moved.index_copy(0, points, torch.cat([bundle.moved_points for bundle in bundles]))
    cameras = [graph.camera for graph in graphs] if len(graphs) > 1 else [bundles[0].camera]
    camera = cameras[0]
    if len(cameras) > 1:
        camera = camera.with_params(torch.stack([each.params for each in cameras])[joined.submap])
    of_bundles = []
    for number, graph in enumerate(graphs):
        place = torch.unique(graph.submap, return_inverse=True)[1]
        of_graph = [b for b, submap in zip(bundles, submaps, strict=True) if submap.graph == number]
        columns = zip(*(bundle.convergence.tensors for bundle in of_graph), strict=True)
        of_bundles.append([torch.cat(column)[place] for column in columns])
    every = (torch.cat(column) for column in zip(*of_bundles, strict=True))
    convergence = Convergence(*every, limit=options.iterations)
    T_cw, success, convergence = _pose_other_frames(
        joined, T_cw, points_w, camera, moved, success, convergence, options
    )
    solutions = []
    for number, graph in enumerate(graphs):
        rows = slice(frame_starts[number], frame_starts[number] + len(graph.T_cw))
        places = slice(point_starts[number], point_starts[number] + len(graph.points_w))
        own = tuple(bundle for bundle, submap in zip(bundles, submaps, strict=True) if submap.graph == number)
        of_frames = Convergence(*(column[rows] for column in convergence.tensors), limit=options.iterations)
        found = T_cw[rows], points_w[places], cameras[number], success[rows], moved[places]
        solutions.append(GraphSolution(graph.timestamps, *found, of_frames, graph.submap, own))
    return tuple(solutions)


def _adjust_together(submaps: Sequence[_GraphSubmap], options: SolverOptions) -> list[BundleSolution]:
    """The bundle adjustment of each submap, found together with those of like size."""
    cells = [len(submap.problem.T_cw) * len(submap.points) for submap in submaps]
    groups: list[list[int]] = []
    for row in sorted(range(len(submaps)), key=lambda row: cells[row]):
        if groups and cells[row] <= 2 * cells[groups[-1][0]]:  # limits the padding to the largest
            groups[-1].append(row)
        else:
            groups.append([row])
    found: dict[int, BundleSolution] = {}
    for rows in groups:
        problems = [submaps[row].problem for row in rows]
        together = solve_bundle(_padded(problems), options=options)
        for number, (row, problem) in enumerate(zip(rows, problems, strict=True)):
            found[row] = together.element(number, len(problem.T_cw), len(problem.points_w))
    return [found[row] for row in range(len(submaps))]


def _padded(problems: Sequence[BundleProblem]) -> BundleProblem:
    """One batch of problems of different sizes, each with a camera of its own."""
    first = problems[0]
    T_cw, points_w, frame_index, point_index, pixels = (
        pad_sequence([getattr(problem, name) for problem in problems], batch_first=True)
        for name in ("T_cw", "points_w", "frame_index", "point_index", "pixels")
    )
    weights = [problem.weights for problem in problems if problem.weights is not None]
    counted = [torch.ones_like(problem.frame_index, dtype=torch.bool) for problem in problems]
    cameras = torch.stack([problem.camera.params for problem in problems])
    camera, mask = first.camera.with_params(cameras), pad_sequence(counted, batch_first=True)
    observed = frame_index, point_index, pixels, camera, pad_sequence(weights, batch_first=True)
    return BundleProblem(T_cw, points_w, *observed, first.fixed_frames, mask=mask)


def _plain(graph: ObservationGraph, number: int) -> ObservationGraph:
    """The columns of `ObservationGraph` alone, in one submap with the number of the graph."""
    columns = {name: getattr(graph, name) for name in ObservationGraph.columns()}
    whole = ObservationGraph(camera=graph.camera, **columns)
    return replace(whole, submap=torch.full_like(graph.submap, number))
