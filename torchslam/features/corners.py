"""Harris responses of small patches and sub-pixel positions, hard (quadratic fit) and soft (arg-max with gradients)."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

WINDOW = 7
HARRIS_K = 0.04


def gather_patches(pixels: Tensor, positions: Tensor, stride: int, radius: int) -> Tensor:
    """Square neighbourhoods out of a flattened image: (P,), (N,) int64 -> (N, side, side), side = 2 radius + 1.

    Whole rows are copied at once, which is ten times faster than an index per pixel.
    """
    side = 2 * radius + 1
    starts = positions - radius * (stride + 1)
    rows = starts[:, None] + torch.arange(side, device=pixels.device) * stride
    return pixels.unfold(0, side, 1).index_select(0, rows.flatten()).view(-1, side, side)


@lru_cache(maxsize=16)
def _sobel(side: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """(side^2, 2 (side - 2)^2): the Sobel derivatives along x and y at all inner pixels of a patch, as a matrix."""
    smooth, slope = torch.tensor([1.0, 2.0, 1.0]), torch.tensor([-1.0, 0.0, 1.0])
    inner = side - 2
    matrix = torch.zeros(side, side, 2, inner, inner)
    for row in range(inner):
        for column in range(inner):
            matrix[row : row + 3, column : column + 3, 0, row, column] = smooth[:, None] * slope
            matrix[row : row + 3, column : column + 3, 1, row, column] = slope[:, None] * smooth
    return matrix.view(side * side, -1).to(device=device, dtype=dtype)


@lru_cache(maxsize=16)
def _windows(inner: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """(inner^2, outputs^2): sums over all WINDOW x WINDOW windows of an inner x inner map, as a matrix."""
    outputs = inner - WINDOW + 1
    matrix = torch.zeros(inner, inner, outputs, outputs)
    for row in range(outputs):
        for column in range(outputs):
            matrix[row : row + WINDOW, column : column + WINDOW, row, column] = 1
    return matrix.view(inner * inner, -1).to(device=device, dtype=dtype)


def harris_responses(patches: Tensor) -> Tensor:
    """Harris corner response wherever its 7x7 window of Sobel derivatives fits (Harris, Stephens, 1988).

    patches: (N, S, S) floats, S >= 9. Returns (N, S - 8, S - 8). For whole-number pixels below 256 the sums are
    whole numbers too, so they do not depend on the order of summation.
    """
    side = patches.shape[-1]
    gradients = patches.flatten(1) @ _sobel(side, patches.device, patches.dtype)
    dx, dy = gradients.chunk(2, dim=-1)
    windows = _windows(side - 2, patches.device, patches.dtype)
    xx, yy, xy = (dx * dx) @ windows, (dy * dy) @ windows, (dx * dy) @ windows
    trace = xx + yy
    responses = (xx * yy - xy * xy) - HARRIS_K * trace * trace
    return responses.unflatten(-1, (side - 8, side - 8))


@lru_cache(maxsize=8)
def _paraboloid_fit(device: torch.device, dtype: torch.dtype) -> Tensor:
    """(9, 5): 3x3 values to the least-squares paraboloid's gx, gy, gxx, gyy, gxy at the centre."""
    slope, bend, ones = torch.tensor([-1.0, 0.0, 1.0]), torch.tensor([1.0, -2.0, 1.0]), torch.ones(3)
    fits = [
        torch.outer(ones, slope) / 6,
        torch.outer(slope, ones) / 6,
        torch.outer(ones, bend) / 3,
        torch.outer(bend, ones) / 3,
        torch.outer(slope, slope) / 4,
    ]
    return torch.stack(fits, dim=-1).view(9, 5).to(device=device, dtype=dtype)


def quadratic_peak(responses: Tensor, limit: float = 0.5) -> Tensor:
    """Offset (x, y) of the maximum of the paraboloid fitted to 3x3 responses, in pixels from the centre.

    responses: (N, 3, 3). Returns (N, 2), within +-limit; zero where the fit has no maximum.
    """
    fit = responses.flatten(1) @ _paraboloid_fit(responses.device, responses.dtype)
    gx, gy, gxx, gyy, gxy = fit.unbind(-1)
    determinant, trace = gxx * gyy - gxy * gxy, gxx + gyy
    peaked = (trace < 0) & (determinant > 1e-6 * trace * trace)
    determinant = torch.where(peaked, determinant, torch.ones_like(determinant))
    offset = torch.stack([gxy * gy - gyy * gx, gxy * gx - gxx * gy], dim=-1) / determinant[:, None]
    return torch.where(peaked[:, None], offset, torch.zeros_like(offset)).clamp(-limit, limit)


def soft_peak(responses: Tensor, temperature: float = 0.2) -> Tensor:
    """Soft arg-max over a neighbourhood: offset (x, y) of its maximum from its centre, differentiable.

    responses: (N, S, S), S odd. They are divided by the largest magnitude of their neighbourhood, so that
    `temperature` has no unit. Returns (N, 2) pixels.
    """
    side = responses.shape[-1]
    scale = responses.abs().amax(dim=(1, 2), keepdim=True).clamp_min(torch.finfo(responses.dtype).tiny)
    weights = torch.softmax((responses / scale / temperature).flatten(1), dim=-1)
    axis = torch.arange(side, device=responses.device, dtype=responses.dtype) - side // 2
    grid = torch.stack([axis.expand(side, side), axis[:, None].expand(side, side)], dim=-1).view(-1, 2)
    return weights @ grid
