"""The observation graph of a run: frames, points and what they see, in memory and in a file; `run_graph` solves it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, Self, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError, safe_open
from torch import Tensor

from torchslam.errors import TorchslamError
from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import OBSERVATION_VARIANCE, CameraMeasurement
from torchslam.geometry.precision import check_dtypes, without_autocast
from torchslam.geometry.rolling_shutter import Readout, frame_velocities, global_shutter_pixels
from torchslam.optim._core.tangent import CameraPrior
from torchslam.optim.bundle._problem import BundleProblem
from torchslam.utils.files import check_regular, parse_json
from torchslam.utils.tensor_file import write_tensors

_ABOUT = "graph"
"""Metadata of a file: the camera's model and size, and the variance of the calibration, as JSON."""
_CALIBRATION = "calibration.params", "calibration.directions"
"""Tensors of a file that has them."""


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
        check_submaps(self)
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


def camera_prior(calibration: CameraMeasurement) -> CameraPrior:
    """A calibration as the prior of a bundle adjustment whose observations have their stated weights."""
    return CameraPrior(calibration.camera.params, calibration.observation_variance * calibration.information)


def row_places(rows: Tensor, count: int) -> Tensor:
    """The place of each of `count` frames or points among some rows; -1 of others."""
    slots = rows.new_full((count,), -1)
    slots[rows] = torch.arange(len(rows), device=slots.device)
    return slots


def keyframe_problem(graph: ObservationGraph, submap: int) -> tuple[Tensor, Tensor, Tensor, BundleProblem]:
    """The keyframes (k,) of one submap, its points (p,), the observations (o,), and their bundle adjustment."""
    frames, rows, points = graph.part(submap)
    keyframes = frames[graph.is_keyframe[frames]]
    slots = row_places(keyframes, len(graph.T_cw))
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


def concatenate_graphs(graphs: Sequence[Graph]) -> Graph:
    """One graph of several with submaps of their own; camera and calibration are those of the first."""
    frames, points = (
        first_rows([graph.T_cw for graph in graphs]),
        first_rows([graph.points_w for graph in graphs]),
    )
    columns: dict[str, Any] = {}
    for name in graphs[0].columns():
        parts = [getattr(graph, name) for graph in graphs]
        if name in ("frame_index", "point_index"):
            starts = frames if name == "frame_index" else points
            parts = [part + start for part, start in zip(parts, starts, strict=True)]
        columns[name] = torch.cat(parts)
    return replace(graphs[0], **columns)


def check_submaps(graph: ObservationGraph) -> None:
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


def first_rows(tables: Sequence[Tensor]) -> list[int]:
    """The first row of each table in their concatenation."""
    return list(accumulate((len(table) for table in tables[:-1]), initial=0))
