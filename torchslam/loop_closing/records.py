"""Records of closed loops and merged submaps: what was measured, so that a loop can be solved again, with gradients."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from safetensors import SafetensorError, safe_open
from torch import Tensor

from torchslam.errors import ResultsError
from torchslam.optim import PoseGraph
from torchslam.utils.files import check_regular, parse_json
from torchslam.utils.tensor_file import write_tensors

PREFIX = "loops."
"""Prefix of the tensors of loops in a file."""


class LoopMatches(NamedTuple):
    """Points that the maps on both sides of a loop have, as the new keyframe observes them.

    `umeyama(points_m, points_k)` is their similarity, differentiable with respect to weights of the matches.

    Attributes:
        keypoint_index: rows of the new keyframe's features.
        pixels: these keypoints.
        points_k: the points as the new keyframe's map has them, in its camera frame.
        points_m: the points as the map of the recognized keyframe has them, in that keyframe's camera frame.
    """

    keypoint_index: Int[Tensor, " M"]
    pixels: Float[Tensor, "M 2"]
    points_k: Float[Tensor, "M 3"]
    points_m: Float[Tensor, "M 3"]


@dataclass(frozen=True)
class LoopEdge:
    """A measured loop in its pose graph, as it was before the correction; independent of later changes of the map.

    Attributes:
        matches: points that measured it.
        S_cw: the keyframes, (K, 4, 4); of a merge only the recognized one, at the origin, and the new one.
        edges: nodes (i, j); the loop is the last edge, from the recognized keyframe to the new one.
        S_ji: measured similarities.
        frame_ids, sessions: index of each keyframe in the sequence of its session, and that session.
    """

    matches: LoopMatches
    S_cw: Float[Tensor, "K 4 4"]
    edges: Int[Tensor, "E 2"]
    S_ji: Float[Tensor, "E 4 4"]
    frame_ids: Int[Tensor, " K"]
    sessions: Int[Tensor, " K"]

    @property
    def graph(self) -> PoseGraph:
        """The pose graph: `solve_pose_graph(edge.graph)` are the corrected keyframes, differentiable."""
        return PoseGraph(self.S_cw, self.edges, self.S_ji, fixed=(0,))


@dataclass(frozen=True)
class LoopClosureRecord:
    """Record of a loop closure or map merge: frames of the new and the recognized keyframe, and their submaps.

    `edge` is what was measured; None in a checkpoint or a results folder of an earlier version.
    """

    frame: int
    matched_frame: int
    submap: int
    matched_submap: int
    edge: LoopEdge | None = field(default=None, compare=False)


def pack_closures(
    closures: Sequence[LoopClosureRecord],
) -> tuple[dict[str, Shaped[Tensor, "..."]], list[list[int]]]:
    """Convert records to tensors by name, and a list for JSON."""
    tensors: dict[str, Tensor] = {}
    about = []
    for number, each in enumerate(closures):
        about.append([each.frame, each.matched_frame, each.submap, each.matched_submap])
        if each.edge is not None:
            own = each.edge.matches._asdict() | {name: getattr(each.edge, name) for name in _COLUMNS}
            tensors |= {f"{PREFIX}{number}.{name}": rows for name, rows in own.items()}
    return tensors, about


def unpack_closures(
    tensors: dict[str, Shaped[Tensor, "..."]], about: Sequence[Sequence[Any]]
) -> list[LoopClosureRecord]:
    """Convert back what `pack_closures` made. Raises ValueError, TypeError or KeyError if that is not whole."""
    closures = []
    for number, numbers in enumerate(about):
        own = {
            name.rpartition(".")[2]: rows
            for name, rows in tensors.items()
            if name.startswith(f"{PREFIX}{number}.")
        }
        edge = None
        if own:
            matches = LoopMatches(**{name: own.pop(name) for name in LoopMatches._fields})
            edge = LoopEdge(matches, **own)
            rows = edge.edges
            if rows.ndim != 2 or not 0 <= int(rows.min()) <= int(rows.max()) < len(edge.S_cw):
                raise ValueError(f"loop {number}: edges {tuple(rows.shape)} of {len(edge.S_cw)} keyframes")
        frame, matched_frame, submap, matched_submap = (int(each) for each in numbers)
        closures.append(LoopClosureRecord(frame, matched_frame, submap, matched_submap, edge))
    return closures


def write_closures(path: str | Path, closures: Sequence[LoopClosureRecord]) -> None:
    """Write records as a safetensors file, atomically; equal records give equal bytes."""
    tensors, about = pack_closures(closures)
    write_tensors(path, tensors, {"loops": json.dumps(about)})


def read_closures(path: str | Path) -> list[LoopClosureRecord]:
    """Read what `write_closures` wrote. Raises ResultsError if that is missing or damaged."""
    try:
        check_regular(path, 1 << 34, "loops that are read")
        with safe_open(str(path), framework="pt") as file:
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
            return unpack_closures(tensors, parse_json((file.metadata() or {})["loops"]))
    except (OSError, SafetensorError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise ResultsError(f"{path}: not the loops of a run of this version: {error}") from None


_COLUMNS = tuple(column.name for column in fields(LoopEdge) if column.name != "matches")


def no_matches(like: Tensor) -> LoopMatches:
    """Matches of a loop that none measured."""
    points = like.new_zeros(0, 3)
    return LoopMatches(torch.zeros(0, dtype=torch.int64, device=like.device), points[:, :2], points, points)
