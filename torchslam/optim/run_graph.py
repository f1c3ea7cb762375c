"""What a run leaves behind, as one differentiable problem: the answer is differentiated, not the path to it.

The trajectory of a finished run minimises the reprojection errors of its observation graph. However many frames
and discrete choices led there, its gradient with respect to every pixel, weight and camera parameter is that of the
minimiser: one linear solve for the keyframes and the points, one small one for each frame in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from torchslam.errors import TorchslamError
from torchslam.geometry import Camera, se3_inverse
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import Kernel
from torchslam.optim import BundleProblem, BundleSolution, bundle_adjust, refine_pose
from torchslam.optim.core.implicit import Backward
from torchslam.optim.core.levenberg_marquardt import Progress
from torchslam.types import Trajectory
from torchslam.utils.bounded_read import check_regular

_FRAMES_AT_ONCE = 64
_MAX_BYTES = 1 << 34

Schema = dict[str, tuple[str, tuple[int, ...], type]]
"""Of whom each column has a row - F frames, P points, O observations -, the shape of a row and the kind of numbers."""


@dataclass(frozen=True)
class ObservationGraph:
    """Who saw what where: O observations of P points by F frames, in any order.

    timestamps:  (F,) float64 seconds
    T_cw:        (F, 4, 4) world to camera, as the run left them
    points_w:    (P, 3)
    frame_index: (O,) int64 rows of T_cw; point_index: (O,) int64 rows of points_w
    pixels:      (O, 2)
    weights:     (O,) inverse variances in px^-2, or (O, 2, 2) inverse covariances
    camera:      one for all frames
    is_keyframe: (F,) bool; keyframes and points are solved together, the other frames against the points
    submap:       (F,) int64 in which world a frame is; worlds share nothing but the camera. All in world 0 if left out
    """

    timestamps: Tensor
    T_cw: Tensor
    points_w: Tensor
    frame_index: Tensor
    point_index: Tensor
    pixels: Tensor
    weights: Tensor
    camera: Camera
    is_keyframe: Tensor
    submap: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))

    _SCHEMA: ClassVar[Schema] = {
        "timestamps": ("F", (), float),
        "T_cw": ("F", (4, 4), float),
        "is_keyframe": ("F", (), bool),
        "submap": ("F", (), int),
        "points_w": ("P", (3,), float),
        "frame_index": ("O", (), int),
        "point_index": ("O", (), int),
        "pixels": ("O", (2,), float),
        "weights": ("O", (), float),
    }

    def __post_init__(self) -> None:
        if len(self.submap) == 0:
            object.__setattr__(self, "submap", torch.zeros_like(self.is_keyframe, dtype=torch.int64))

    @property
    def submaps(self) -> list[int]:
        """The worlds that there are, ascending."""
        return [
            int(submap) for submap in torch.unique(self.submap)
        ]  # `tolist` fails in transforms of torch 2.5

    def part(self, submap: int) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of the frames, the observations and the points of one world; points without observations have none."""
        frames = (self.submap == submap).nonzero().squeeze(-1)
        rows = (self.submap[self.frame_index] == submap).nonzero().squeeze(-1)
        return frames, rows, torch.unique(self.point_index[rows])

    def save(self, path: str | Path) -> None:
        """Write to a safetensors file."""
        tensors = {name: getattr(self, name).detach().cpu().contiguous() for name in self.columns()}
        tensors["camera"] = self.camera.params.detach().cpu().contiguous()
        width, height = self.camera.size
        metadata = {"camera_model": self.camera.model, "camera_size": f"{width} {height}"}
        safetensors.torch.save_file(tensors, path, metadata)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote. Raises TorchslamError where the file is something else.

        A file of a graph that knows more than this class is read without the rest; one from before there were worlds
        has one.
        """
        try:
            check_regular(path, _MAX_BYTES, "a graph that is read")
            with safe_open(str(path), framework="pt") as file:
                metadata, known = file.metadata() or {}, set(file.keys())
                names = [name for name in cls.columns() if name in known or name != "submap"]
                tensors = {name: file.get_tensor(name) for name in (*names, "camera")}
            width, height = metadata["camera_size"].split()
            camera = Camera(metadata["camera_model"], tensors["camera"], (int(width), int(height)))
            graph = cls(camera=camera, **{name: tensors[name] for name in names})
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
        """Raises ValueError where a column does not fit the others, or names rows that there are not."""
        rows = {"F": len(self.T_cw), "P": len(self.points_w), "O": len(self.pixels)}
        for name, (owner, shape, kind) in self._SCHEMA.items():
            column = getattr(self, name)
            if name == "weights" and column.ndim == 3:
                shape = (2, 2)
            if tuple(column.shape) != (rows[owner], *shape):
                raise ValueError(f"{name} is {tuple(column.shape)}, not {(rows[owner], *shape)}")
            is_float = kind is float and column.is_floating_point()
            if not is_float and column.dtype != {int: torch.int64, bool: torch.bool}.get(kind):
                raise ValueError(f"{name} is of type {column.dtype}")
            if not bool(column.isfinite().all()):
                raise ValueError(f"{name} is not finite")
        for name, owner in (("frame_index", "F"), ("point_index", "P")):
            index = getattr(self, name)
            if len(index) and not 0 <= int(index.min()) <= int(index.max()) < rows[owner]:
                raise ValueError(f"{name} from {int(index.min())} to {int(index.max())} of {rows[owner]}")
        params = self.camera.params
        if params.ndim != 1 or not bool(params.isfinite().all()) or not bool((params[:2] > 0).all()):
            raise ValueError("the camera's parameters are none")
        weights = self.weights.diagonal(dim1=1, dim2=2) if self.weights.ndim == 3 else self.weights
        if min(self.camera.size) < 1 or bool((weights < 0).any()):
            raise ValueError("an image without pixels, or a negative weight")

    @classmethod
    def columns(cls) -> list[str]:
        """The names of all tensors but the camera's."""
        return [column.name for column in fields(cls) if column.name != "camera"]


Graph = TypeVar("Graph", bound=ObservationGraph)


@dataclass(frozen=True)
class GraphSolution:
    """The minimiser of a graph, differentiable with respect to its pixels, weights and camera.

    T_cw:      (F, 4, 4); points_w: (P, 3)
    camera:    of all frames, with other parameters where it was free
    success:   (F,) bool. A frame that its observations do not determine stays where it was, without gradient; if the
               keyframes of a world together are not determined, none of them succeeds.
    moved_points: (P,) bool. What too few keyframes see stayed where it was; its observations did not count.
    converged: (F,) bool, the search for a frame's pose, and before for its world's keyframes and points, ended at a
               minimum. Elsewhere the poses are nearly right, but the gradient may be wrong by any factor.
    submap:     (F,) in which world a frame is; poses and points of different worlds have nothing to do with each other
    keyframes: the bundle adjustments of keyframes and points, with their covariances, one per world in the order of
               `ObservationGraph.submaps`; rows are those of the world's keyframes and of the points its frames see
    """

    timestamps: Tensor
    T_cw: Tensor
    points_w: Tensor
    camera: Camera
    success: Tensor
    moved_points: Tensor
    converged: Tensor
    submap: Tensor
    keyframes: tuple[BundleSolution, ...]

    @property
    def trajectory(self) -> Trajectory:
        """Camera to world, ordered by time, differentiable; of the world with most frames."""
        worlds, frames = torch.unique(self.submap, return_counts=True)
        return self.trajectory_in(int(worlds[frames.argmax()]))

    def trajectory_in(self, submap: int) -> Trajectory:
        """Camera to world, ordered by time, differentiable; of one world."""
        rows = (self.submap == submap).nonzero().squeeze(-1)
        order = rows[torch.argsort(self.timestamps[rows], stable=True)]
        return Trajectory(self.timestamps[order], se3_inverse(self.T_cw[order]))


@full_precision
def solve(
    graph: ObservationGraph,
    kernel: Kernel = "huber",
    scale: Tensor | float = 2.45,
    free_camera: bool | Tensor = False,
    backward: Backward = "implicit",
    iterations: int = 30,
    tolerance: float = 1e-10,
    progress: Progress | None = None,
) -> GraphSolution:
    """Minimise the robust reprojection errors of a run's graph: keyframes and points, then the frames in between.

    Every world is solved on its own: its first keyframe stays where it is, and so does its scale; a loss should not
    depend on them, as aligned trajectory errors do not. Options as in `bundle_adjust`; the default kernel ends its
    quadratic part at 95 % of a Gaussian. Raises ValueError if a world has no keyframe, if a point is seen in two
    worlds, and for `free_camera` with several worlds, of which each would find a camera of its own.
    """
    worlds = graph.submaps
    if free_camera is not False and len(worlds) > 1:
        raise ValueError("a free camera needs a graph of one world")
    solved = graph.points_w.new_zeros(len(graph.points_w), dtype=torch.int64)
    T_cw, points_w = graph.T_cw.detach(), graph.points_w.detach()
    success, moved = torch.zeros_like(graph.is_keyframe), torch.zeros_like(solved, dtype=torch.bool)
    bundles: list[BundleSolution] = []
    options = (kernel, scale, backward, iterations, tolerance)
    for submap in worlds:
        keyframes, points, problem = keyframes_of(graph, submap)
        solved[points] += 1
        bundle = bundle_adjust(
            problem, kernel, scale, free_camera, backward, iterations, tolerance, progress=progress
        )
        bundles.append(bundle)
        T_cw, points_w = (
            T_cw.index_copy(0, keyframes, bundle.T_cw),
            points_w.index_copy(0, points, bundle.points_w),
        )
        finite = torch.isfinite(problem.T_cw).flatten(1).all(-1)
        success = success.index_copy(0, keyframes, bundle.success & finite)
        moved = moved.index_copy(0, points, bundle.moved_points)
    if bool((solved > 1).any()):
        raise ValueError("a point is seen in two worlds")
    if not bundles:
        raise ValueError("the graph has no keyframe")
    camera = bundles[0].camera
    T_cw, success, settled = between(graph, T_cw, points_w, camera, moved, success, *options)
    found = T_cw, points_w, camera, success, moved, settled & converged_of(graph, bundles)
    return GraphSolution(graph.timestamps, *found, graph.submap, tuple(bundles))


def keyframes_of(graph: ObservationGraph, submap: int) -> tuple[Tensor, Tensor, BundleProblem]:
    """The keyframes (k,) of one world, its points (p,), and their bundle adjustment.

    Raises ValueError where there is no keyframe.
    """
    frames, rows, points = graph.part(submap)
    keyframes = frames[graph.is_keyframe[frames]]
    if len(keyframes) == 0:
        raise ValueError("a world of the graph has no keyframe")
    slots = torch.full_like(graph.submap, -1)
    slots[keyframes] = torch.arange(len(keyframes), device=slots.device)
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
    return keyframes, points, problem


def converged_of(graph: ObservationGraph, bundles: Sequence[BundleSolution]) -> Tensor:
    """(F,) whether the bundle adjustment of each frame's world, in the order of `graph.submaps`, has converged."""
    converged = torch.cat([bundle.convergence.converged for bundle in bundles])
    return converged[torch.unique(graph.submap, return_inverse=True)[1]]


def between(
    graph: ObservationGraph,
    T_cw: Tensor,
    points_w: Tensor,
    camera: Camera,
    moved: Tensor,
    success: Tensor,
    kernel: Kernel,
    scale: Tensor | float,
    backward: Backward,
    iterations: int,
    tolerance: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """The poses T_cw (F, 4, 4), those of frames that are no keyframes found against the points; who succeeded, and
    whose search ended at a minimum: all keyframes, here.

    camera: of all frames, or with params (F, K) of each its own
    """
    others = (~graph.is_keyframe).nonzero().squeeze(-1)
    in_rank = torch.argsort(graph.frame_index, stable=True)
    counts = torch.bincount(graph.frame_index, minlength=len(graph.T_cw))
    starts, converged = counts.cumsum(0) - counts, torch.ones_like(success)
    for frames in others.split(_FRAMES_AT_ONCE) if len(others) else ():
        slot = torch.arange(int(counts[frames].max()), device=frames.device)
        mask = slot < counts[frames, None]
        seen = in_rank[torch.where(mask, starts[frames, None] + slot, 0)]
        mask = mask & moved[graph.point_index[seen]]
        refined = refine_pose(
            graph.T_cw[frames],
            points_w[graph.point_index[seen]],
            graph.pixels[seen],
            camera if camera.params.ndim == 1 else camera[frames],
            graph.weights[seen],
            mask,
            kernel,
            scale,
            backward=backward,
            iterations=iterations,
            tolerance=tolerance,
        )
        T_cw = T_cw.index_copy(0, frames, refined.T_cw)
        success = success.index_copy(0, frames, refined.success)
        converged = converged.index_copy(0, frames, refined.convergence.converged)
    return T_cw, success, converged


def join(graphs: Sequence[Graph]) -> Graph:
    """One graph of several that are each of a world of their own; they have the camera of the first."""
    frames, points = (
        torch.tensor([0, *(len(getattr(graph, name)) for graph in graphs)]).cumsum(0).tolist()
        for name in ("T_cw", "points_w")
    )
    columns: dict[str, Any] = {}
    for name in graphs[0].columns():
        parts = [getattr(graph, name) for graph in graphs]
        if name in ("frame_index", "point_index"):
            starts = frames if name == "frame_index" else points
            parts = [part + start for part, start in zip(parts, starts, strict=False)]
        columns[name] = torch.cat(parts)
    return replace(graphs[0], **columns)
