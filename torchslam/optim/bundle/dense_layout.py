"""Where the frames, points and observations of many small bundle adjustments stand in the grids that solve them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.optim.bundle.problem import Given, Inputs, flat_rows
from torchslam.optim.bundle.sparse_layout import Moving

# An observation of the sparse equations costs as much as so many cells of a grid.
_SPARSEST = 8


class GridLayout(NamedTuple):
    """The discrete part of the problems; every tensor leads with the batch.

    order:   (B, F) rows of T_cw, those that move first; rank: (B, F) its inverse
    cells:   (B, O) place of each observation among the F * P cells of its grid, the one after them if it does not count
    free:    (B, F') which of the first F' move, F' being the most of any problem
    anchors: (B, F) which of the ordered frames stay and see something
    free_points: (B, P); held_points: (B,) whether a point that is seen stays
    """

    order: Tensor
    rank: Tensor
    cells: Tensor
    free: Tensor
    anchors: Tensor
    free_points: Tensor
    held_points: Tensor


class GridData(NamedTuple):
    """All that the problems are made of, in the layout's order.

    inputs:    as `Inputs`, but pixels (B, F, 2, P) and weights (B, F, P), zero where nothing was seen
    camera_of: (B, F) the camera of each frame
    """

    layout: GridLayout
    inputs: Inputs
    camera_of: Tensor


def fits_grids(given: Given, moving: Moving) -> bool:
    """Whether grids are the faster way: no point is seen twice in a frame, and few cells are empty."""
    num_frames, num_points = moving.frames.shape[1], moving.points.shape[1]
    cells = moving.frames.numel() * num_points
    if given.weights.ndim > 2:
        return False  # whitening makes the grids' way of a pinhole camera a longer one
    if not 0 < cells <= _SPARSEST * int(moving.counted.sum()):
        return False
    places = flat_rows(given.frame_index * num_points + given.point_index, num_frames * num_points)
    return int(torch.bincount(places[moving.counted.flatten()], minlength=1).max()) <= 1


def build_grid_layout(given: Given, moving: Moving) -> GridLayout:
    """The grids of problems that `fits_grids`."""
    num_frames, num_points = moving.frames.shape[1], moving.points.shape[1]
    order = torch.argsort((~moving.frames).int(), dim=1, stable=True)
    rank = torch.argsort(order, dim=1)
    counts = moving.frames.sum(1)
    slots = torch.arange(int(counts.max()), device=counts.device)
    frames = rank.gather(1, given.frame_index)
    seeing = torch.zeros_like(rank).scatter_add(1, frames, moving.counted.long()) > 0
    held = moving.counted & ~moving.points.gather(1, given.point_index)
    return GridLayout(
        order,
        rank,
        torch.where(moving.counted, frames * num_points + given.point_index, num_frames * num_points),
        slots < counts[:, None],
        seeing & ~moving.frames.gather(1, order),
        moving.points,
        held.any(1),
    )


def grid_data(layout: GridLayout, given: Given) -> GridData:
    """The grids, filled."""
    inputs = given.inputs._replace(
        T_cw=take(given.T_cw, layout.order),
        pixels=_spread(layout, given.pixels.mT),
        weights=_spread(layout, given.weights[:, None])[:, :, 0],
    )
    if inputs.pose_prior is not None:
        inputs = inputs._replace(
            prior_T_cw=take(given.prior_T_cw, layout.order),
            prior_information=take(given.prior_information, layout.order),
        )
    return GridData(layout, inputs, given.camera_index.gather(1, layout.order))


def take(tensor: Tensor, rows: Tensor) -> Tensor:
    """Rows (B, N) of (B, F, ...)."""
    index = rows.view(*rows.shape, *(1,) * (tensor.ndim - 2))
    return tensor.gather(1, index.expand(*rows.shape, *tensor.shape[2:]))


def _spread(layout: GridLayout, values: Tensor) -> Tensor:
    """Values (B, D, O) of observations in their cells, (B, F, D, P)."""
    (batch, num_frames), num_points = layout.order.shape, layout.free_points.shape[1]
    grid = values.new_zeros(batch, values.shape[1], num_frames * num_points + 1)
    grid = grid.scatter(2, layout.cells[:, None].expand_as(values), values)[..., :-1]
    return grid.unflatten(-1, (num_frames, num_points)).transpose(1, 2).contiguous()
