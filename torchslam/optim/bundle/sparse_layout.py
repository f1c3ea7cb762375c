"""The discrete part of bundle adjustments: what moves, what counts, and in which order it is processed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.optim.bundle.problem import Given, flat_rows
from torchslam.optim.bundle.schur import Structure, build_structure

_MIN_POINTS_PER_FRAME = 3
_MIN_FRAMES_PER_POINT = 2


@dataclass(frozen=True)
class Layout:
    """The order in which one bundle adjustment is processed, and what of it moves.

    observations: (O',) rows of the problem's observations that count, ordered as `Structure` asks
    frame_index:  (O',) rows of T_cw; point_index: (O',) positions in point_order
    point_order:  (P,) rows of points_w, ordered as `Structure` asks; point_rank: (P,) its inverse
    free_frames:  (F',) rows of T_cw that move; free_points: (P,) bool, in point_order
    """

    observations: Tensor
    frame_index: Tensor
    point_index: Tensor
    point_order: Tensor
    point_rank: Tensor
    free_frames: Tensor
    free_points: Tensor
    structure: Structure


class Moving(NamedTuple):
    """(B, O) bool, the observations that count; (B, F), (B, P) bool, the frames and points that move."""

    counted: Tensor
    frames: Tensor
    points: Tensor


def what_moves(given: Given) -> Moving:
    """Of what may move, points seen less than twice and frames that see less than three points and have no prior stay,
    and are not observed."""
    frame_index, point_index, counted = given.frame_index, given.point_index, given.counted
    seen = _counts(point_index, counted, given.free_points) >= _MIN_FRAMES_PER_POINT
    counted = counted & (seen | ~given.free_points).gather(1, point_index)
    seeing = _counts(frame_index, counted, given.free_frames) >= _MIN_POINTS_PER_FRAME
    if given.inputs.pose_prior is not None:
        seeing = seeing | (given.prior_information != 0).flatten(2).any(-1)
    counted = counted & (seeing | ~given.free_frames).gather(1, frame_index)
    return Moving(counted, given.free_frames & seeing, given.free_points & seen)


def _counts(index: Tensor, counted: Tensor, of: Tensor) -> Tensor:
    """How many counted rows of index (B, O) there are of each of `of`. -> (B, N)."""
    rows = flat_rows(index, of.shape[1])[counted.flatten()]
    return torch.bincount(rows, minlength=of.numel()).view(of.shape)


def build_layout(
    frame_index: Tensor, point_index: Tensor, counted: Tensor, free_frames: Tensor, free_points: Tensor
) -> Layout:
    """Order the observations (O,) that count of free and fixed frames (F,) and points (P,), as `Moving` has them."""
    num_points = len(free_points)
    count = int(free_frames.sum())
    slots = torch.where(free_frames, free_frames.cumsum(0) - 1, count)
    rows = counted.nonzero().squeeze(-1)
    rows = rows[torch.argsort(slots[frame_index[rows]], stable=True)]
    first = torch.full((num_points,), count, device=rows.device)
    first = first.scatter_reduce(0, point_index[rows], slots[frame_index[rows]], "amin")
    point_order = torch.argsort(first, stable=True)
    point_rank = torch.argsort(point_order)
    points = point_rank[point_index[rows]]
    structure = build_structure(slots[frame_index[rows]], points, count, num_points)
    return Layout(
        rows,
        frame_index[rows],
        points,
        point_order,
        point_rank,
        free_frames.nonzero().squeeze(-1),
        free_points[point_order],
        structure,
    )


def camera_columns(directions: Tensor, num_cameras: int) -> Tensor:
    """(C, 3 + K, 3 + C n) from a point and the steps of all cameras along n directions (K, n) to the point and the
    parameters of one of them."""
    eye = torch.eye(3, dtype=directions.dtype, device=directions.device)
    own = torch.eye(num_cameras, dtype=directions.dtype, device=directions.device)
    return torch.stack([torch.block_diag(eye, torch.kron(row[None], directions)) for row in own])
