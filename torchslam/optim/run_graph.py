"""The observation graph of a run as one differentiable least-squares problem: its minimum is differentiated.

The trajectory of a finished run minimizes the reprojection errors of its observation graph. However many frames
and discrete choices led there, its gradient with respect to every pixel, weight and camera parameter is that of the
minimizer: one linear solve for the keyframes and the points, one small one for each frame in between.

With a rolling shutter, rounds of two steps follow each other: the keypoints are moved to where the middle row would
have seen them, by the present poses, points and camera, and the graph of a global shutter is solved. The rounds settle
quickly, since poses hardly change the motion between them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchslam.errors import TorchslamError
from torchslam.geometry import Camera, se3_inverse
from torchslam.geometry.camera_measurement import OBSERVATION_VARIANCE, CameraMeasurement
from torchslam.geometry.precision import (
    check_dtypes,
    full_precision,
    in_widest_precision,
    without_autocast,
)
from torchslam.geometry.rolling_shutter import Readout, frame_velocities, global_shutter_pixels
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
from torchslam.optim._core.tangent import CameraPrior
from torchslam.optim.bundle._factors import DepthPrior, Factors
from torchslam.optim.bundle._problem import BundleProblem
from torchslam.optim.bundle._solve import BundleSolution, solve_bundle
from torchslam.optim.pose import solve_pose
from torchslam.types import Trajectory
from torchslam.utils.files import check_regular, parse_json
from torchslam.utils.memory import available_memory
from torchslam.utils.tensor_file import write_tensors

_ABOUT = "graph"
"""Metadata of a file: the camera's model and size, and the variance of the calibration, as JSON."""
_CALIBRATION = "calibration.params", "calibration.directions"
"""Tensors of a file that has them."""
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
class ObservationGraph:
    """O observations of N points by K frames, in any order.

    Attributes:
        timestamps: seconds.
        T_cw: world to camera, as the run left them.
        frame_index: rows of T_cw.
        point_index: rows of points_w.
        weights: inverse variances in px^-2, or (O, 2, 2) inverse covariances. Their scale is absolute: the kernel
            counts residuals in standard deviations, so that weights a thousand times too large make outliers of all.
        camera: one for all frames.
        is_keyframe: Keyframes and points are solved together, the other frames against the points.
        submap: submap of each frame, 0 if omitted. Submaps share nothing but the camera.
        calibration: the given camera with its error, the prior of `camera`; None: `camera` is exact.
        readout: of a rolling shutter, for which `pixels` are not corrected; None: a global shutter.
    """

    timestamps: Float[Tensor, " K"]
    T_cw: Float[Tensor, "K 4 4"]
    points_w: Float[Tensor, "N 3"]
    frame_index: Int[Tensor, " O"]
    point_index: Int[Tensor, " O"]
    pixels: Float[Tensor, "O 2"]
    weights: Float[Tensor, " O"] | Float[Tensor, "O 2 2"]
    camera: Camera
    is_keyframe: Bool[Tensor, " K"]
    submap: Int[Tensor, " K"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64, device="cpu"))
    calibration: CameraMeasurement | None = None
    readout: Readout | None = None

    def __post_init__(self) -> None:
        if len(self.submap) == 0:
            object.__setattr__(self, "submap", torch.zeros_like(self.is_keyframe, dtype=torch.int64))

    @property
    def submaps(self) -> list[int]:
        """The numbers of the submaps, ascending."""
        return [
            int(submap) for submap in torch.unique(self.submap)
        ]  # `tolist` fails in transforms of torch 2.5

    @property
    def main_submap(self) -> int:
        """The number of the submap with most keyframes."""
        return int(torch.bincount(self.submap[self.is_keyframe]).argmax())

    def part(self, submap: int) -> tuple[Int[Tensor, " n"], Int[Tensor, " m"], Int[Tensor, " p"]]:
        """Rows of the frames, the observations and the points of one submap; points without observations have none."""
        frames = (self.submap == submap).nonzero().squeeze(-1)
        rows = (self.submap[self.frame_index] == submap).nonzero().squeeze(-1)
        return frames, rows, torch.unique(self.point_index[rows])

    @property
    def recordings(self) -> Int[Tensor, " K"]:
        """The recording of each frame: frames of different ones are no neighbors in time."""
        return self.submap

    def global_shutter(self) -> Self:
        """The graph of a global shutter, keypoints corrected by the poses, points and camera; itself if it is one."""
        if self.readout is None:
            return self
        rows = torch.arange(len(self.pixels), device=self.pixels.device)
        return replace(self, pixels=self.global_shutter_pixels(rows), readout=None)

    def global_shutter_pixels(self, rows: Int[Tensor, " R"]) -> Float[Tensor, "R 2"]:
        """The keypoints of some observations, corrected as in `global_shutter`."""
        if self.readout is None:
            return self.pixels[rows]
        frame = self.frame_index[rows]
        velocities, _ = frame_velocities(self.T_cw, self.timestamps, self.recordings)
        return global_shutter_pixels(
            self.pixels[rows],
            self.T_cw[frame],
            velocities[frame],
            self.points_w[self.point_index[rows]],
            self.camera,
            self.readout.seconds.to(self.pixels),
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """The same graph on a device, with a dtype of all floats but the timestamps."""

        def moved(name: str, column: Tensor) -> Tensor:
            return column.to(device, dtype if column.is_floating_point() and name != "timestamps" else None)

        def camera(camera: Camera) -> Camera:
            return camera.to(device=device, dtype=dtype or camera.params.dtype)

        given, readout = self.calibration, self.readout
        if given is not None:
            directions = moved("directions", given.directions)
            given = replace(given, camera=camera(given.camera), directions=directions)
        if readout is not None:
            readout = replace(readout, seconds=readout.seconds.to(device))
        columns = {name: moved(name, getattr(self, name)) for name in self.columns()}
        return replace(self, camera=camera(self.camera), calibration=given, readout=readout, **columns)

    def window(self, first: float, last: float) -> Self:
        """The frames from one time to another, seconds, and the points that at least two of their keyframes see.

        A graph of its own, solved with the memory of its own observations, which carries gradients to all columns of
        this one. Submaps that have fewer than two keyframes there are left out.

        Raises ValueError where none is left.
        """
        frames = (self.timestamps >= first) & (self.timestamps <= last)
        numbers, submap = torch.unique(self.submap, return_inverse=True)
        keyframes = torch.bincount(submap[frames & self.is_keyframe], minlength=len(numbers))
        frames = frames & (keyframes >= 2)[submap]
        if not bool(frames.any()):
            raise ValueError(f"no two keyframes of a submap from {first:g} to {last:g} s")
        of_keyframe = (frames & self.is_keyframe)[self.frame_index]
        seen = torch.bincount(self.point_index[of_keyframe], minlength=len(self.points_w))
        points = seen >= 2
        rows = frames[self.frame_index] & points[self.point_index]
        chosen = {"frame_index": rows, "point_index": rows, "pixels": rows, "weights": rows}
        chosen |= {"keypoint_index": rows, "points_w": points, "point_ids": points}
        columns = {name: getattr(self, name)[chosen.get(name, frames)] for name in self.columns()}
        for name, kept in (("frame_index", frames), ("point_index", points)):
            columns[name] = (kept.cumsum(0) - 1)[columns[name]]
        return replace(self, **columns)

    def save(self, path: str | Path) -> None:
        """Write to a safetensors file, atomically; equal graphs give equal bytes."""
        tensors: dict[str, Tensor] = {name: getattr(self, name) for name in self.columns()}
        tensors["camera"] = self.camera.params
        width, height = self.camera.size
        metadata = {"camera_model": self.camera.model, "camera_size": f"{width} {height}"}
        if (given := self.calibration) is not None:
            tensors |= zip(_CALIBRATION, (given.camera.params, given.directions), strict=True)
            metadata["observation_variance"] = repr(given.observation_variance)
        if self.readout is not None:
            tensors["readout"] = self.readout.numbers
        write_tensors(path, tensors, {_ABOUT: json.dumps(metadata)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote: a `RunGraph` where the file has the origin of the rows, and one submap where it has
        none.

        Raises TorchslamError where the file is something else.
        """
        try:
            check_regular(path, 1 << 34, "a graph that is read")
            with safe_open(str(path), framework="pt") as file:
                metadata, known = file.metadata() or {}, set(file.keys())
                metadata = (
                    parse_json(metadata[_ABOUT]) if _ABOUT in metadata else metadata
                )  # of earlier versions
                # From here on `cls` is what the file holds; in the signature, what is asked for.
                if cls is ObservationGraph and set(RunGraph.columns()) <= known | {"submap"}:
                    cls = RunGraph  # type: ignore[assignment]
                names = [name for name in cls.columns() if name in known or name != "submap"]
                given = _CALIBRATION if set(_CALIBRATION) <= known else ()
                shutter = ("readout",) if "readout" in known else ()
                tensors = {name: file.get_tensor(name) for name in (*names, "camera", *given, *shutter)}
            width, height = metadata["camera_size"].split()
            camera = Camera(metadata["camera_model"], tensors["camera"], (int(width), int(height)))
            calibration = None
            if given:
                params, directions = (tensors[name] for name in given)
                # Earlier versions wrote none.
                variance = float(metadata.get("observation_variance", OBSERVATION_VARIANCE))
                calibration = CameraMeasurement(camera.with_params(params), directions, variance)
            columns = {name: tensors[name] for name in names}
            readout = Readout.from_numbers(tensors["readout"]) if shutter else None
            graph = cls(camera=camera, calibration=calibration, readout=readout, **columns)
            graph._check()
            return graph
        except (
            OSError,
            SafetensorError,
            KeyError,
            ValueError,
            TypeError,
            AttributeError,
            RuntimeError,
        ) as error:
            raise TorchslamError(f"{path} is not an observation graph: {error}") from error

    def _check(self) -> None:
        """Raises ValueError where a column does not fit the others, or has indices out of range."""
        if isinstance(self, RunGraph):
            _run_fits(self)
        else:
            _fits(self)
        for name in self.columns():
            column, wanted = getattr(self, name), self.camera.params.dtype
            if name in ("T_cw", "points_w", "pixels", "weights") and column.dtype != wanted:
                raise ValueError(f"{name} is of type {column.dtype}, not {wanted}")
            if not bool(column.isfinite().all()):
                raise ValueError(f"{name} is not finite")
        for name, count in (("frame_index", len(self.T_cw)), ("point_index", len(self.points_w))):
            index = getattr(self, name)
            if len(index) and not 0 <= int(index.min()) <= int(index.max()) < count:
                raise ValueError(f"{name} from {int(index.min())} to {int(index.max())} of {count}")
        _check_submaps(self)
        params = self.camera.params
        check_dtypes(camera=params)
        if params.ndim != 1 or not bool(params.isfinite().all()) or not bool((params[:2] > 0).all()):
            raise ValueError("the camera's parameters are invalid")
        if self.calibration is not None:
            given = self.calibration.camera.params, self.calibration.directions
            check_dtypes(camera=params, calibration=given[0], directions=given[1])
            if given[0].shape != params.shape or given[1].ndim != 2 or len(given[1]) != len(params):
                raise ValueError(
                    f"the calibration has {len(given[0])} parameters and directions {tuple(given[1].shape)}; "
                    f"the camera has {len(params)} parameters"
                )
            if not all(bool(part.isfinite().all()) for part in given):
                raise ValueError("the calibration is not finite")
            if not 0 < self.calibration.observation_variance < math.inf:
                raise ValueError("the calibration's observation variance is not above zero and finite")
        weights = self.weights.diagonal(dim1=1, dim2=2) if self.weights.ndim == 3 else self.weights
        if min(self.camera.size) < 1 or max(self.camera.size) > 1 << 26 or bool((weights < 0).any()):
            raise ValueError("an image of an impossible size, or a negative weight")

    @classmethod
    def columns(cls) -> list[str]:
        """The names of all tensors but those of the camera, its calibration and readout."""
        others = "camera", "calibration", "readout"
        return [column.name for column in fields(cls) if column.name not in others]


@dataclass(frozen=True, kw_only=True)
class RunGraph(ObservationGraph):
    """The observation graph of a submap, with the origin of its rows.

    Attributes:
        frame_ids: index of each frame in the sequence of its session.
        sessions: session of each frame.
        point_ids: row of each point in the submap's map.
        keypoint_index: row of each observation among the frame's features, to read its pixels anew from an extractor.
    """

    frame_ids: Int[Tensor, " K"]
    sessions: Int[Tensor, " K"]
    point_ids: Int[Tensor, " N"]
    keypoint_index: Int[Tensor, " O"]

    @property
    def recordings(self) -> Int[Tensor, " K"]:
        """The recording of each frame: those of one session in one submap."""
        if not len(self.sessions):
            return self.submap
        return self.submap * (1 + int(self.sessions.max())) + self.sessions


@without_autocast
def _fits(graph: ObservationGraph) -> None:
    """Raises ValueError where a column is of another kind or does not fit the others."""


@without_autocast
def _run_fits(graph: RunGraph) -> None:
    """As `_fits`."""


Graph = TypeVar("Graph", bound=ObservationGraph)


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
    slots, own = _slots(submap.keyframes, len(graph.T_cw)), []
    of_points = _slots(submap.points, len(graph.points_w))
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


def _slots(rows: Tensor, count: int) -> Tensor:
    """The place of each of `count` frames or points among some rows; -1 of others."""
    slots = rows.new_full((count,), -1)
    slots[rows] = torch.arange(len(rows), device=slots.device)
    return slots


def camera_prior(calibration: CameraMeasurement) -> CameraPrior:
    """A calibration as the prior of a bundle adjustment whose observations have their stated weights."""
    return CameraPrior(calibration.camera.params, calibration.observation_variance * calibration.information)


def _check_submaps(graph: ObservationGraph) -> None:
    """Raises ValueError where a submap has no keyframe, or a point is seen in two submaps."""
    if not bool(graph.is_keyframe.any()):
        raise ValueError("the graph has no keyframe")
    submaps, number = torch.unique(graph.submap, return_inverse=True)
    if len(torch.unique(number[graph.is_keyframe])) < len(submaps):
        raise ValueError("a submap of the graph has no keyframe")
    seen_in = number[graph.frame_index]
    first = number.new_full((len(graph.points_w),), len(submaps))
    first = first.scatter_reduce(0, graph.point_index, seen_in, "amin")
    if bool((first[graph.point_index] != seen_in).any()):
        raise ValueError("a point is seen in two submaps")


def keyframe_problem(graph: ObservationGraph, submap: int) -> tuple[Tensor, Tensor, Tensor, BundleProblem]:
    """The keyframes (k,) of one submap, its points (p,), the observations (o,), and their bundle adjustment."""
    frames, rows, points = graph.part(submap)
    keyframes = frames[graph.is_keyframe[frames]]
    slots = _slots(keyframes, len(graph.T_cw))
    rows = rows[graph.is_keyframe[graph.frame_index[rows]]]
    problem = BundleProblem(
        graph.T_cw[keyframes],
        graph.points_w[points],
        slots[graph.frame_index[rows]],
        torch.searchsorted(points, graph.point_index[rows]),
        graph.pixels[rows],
        graph.camera,
        graph.weights[rows],
        fixed_frames=(0,),
    )
    return keyframes, points, rows, problem


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


def concatenate_graphs(graphs: Sequence[Graph]) -> Graph:
    """One graph of several with submaps of their own; camera and calibration are those of the first."""
    frames, points = _starts([graph.T_cw for graph in graphs]), _starts([graph.points_w for graph in graphs])
    columns: dict[str, Any] = {}
    for name in graphs[0].columns():
        parts = [getattr(graph, name) for graph in graphs]
        if name in ("frame_index", "point_index"):
            starts = frames if name == "frame_index" else points
            parts = [part + start for part, start in zip(parts, starts, strict=True)]
        columns[name] = torch.cat(parts)
    return replace(graphs[0], **columns)


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
        _check_submaps(graph)
    submaps = [
        _GraphSubmap(number, *keyframe_problem(graph, submap))
        for number, graph in enumerate(graphs)
        for submap in graph.submaps
    ]
    bundles = adjust(submaps)
    # Rows of all graphs, one after the other, as `concatenate_graphs` has them; `submap` distinguishes the graphs.
    joined = concatenate_graphs([_plain(graph, number) for number, graph in enumerate(graphs)])
    frame_starts, point_starts = _starts([g.T_cw for g in graphs]), _starts([g.points_w for g in graphs])
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


def _starts(tables: Sequence[Tensor]) -> list[int]:
    """The first row of each table in their concatenation."""
    return list(accumulate((len(table) for table in tables[:-1]), initial=0))
