"""Depth that several views agree on: maps of neighbors are rendered into a view, compared with its own and merged."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.dense.cost_volume import warp
from torchslam.geometry import Camera, se3_inverse

TOLERANCE = 0.02
"""Relative difference of depths at which one gives half a vote to another; from twice as much on, none."""


class Merged(NamedTuple):
    """Depth of a view after the views were compared.

    Attributes:
        inverse_depth: mean of the views that agree, 1 / map units; 0 where no view knows the depth.
        support: sum of the votes of the views, the view itself among them: the confidence of each where they agree.
        spread: relative standard deviation of the depths that agree.
        conflicts: sum of the confidence of views that see a surface in front.
        agrees: 1 where the view's own depth is among those that agree, else 0.
    """

    inverse_depth: Float[Tensor, "H W"]
    support: Float[Tensor, "H W"]
    spread: Float[Tensor, "H W"]
    conflicts: Float[Tensor, "H W"]
    agrees: Float[Tensor, "H W"]


def render(
    inverse_depth: Float[Tensor, "B H W"], camera: Camera, T_ts: Float[Tensor, "B 4 4"]
) -> Float[Tensor, "B H W"]:
    """Render depth maps from other poses: every pixel covers the four around its place, the nearest depth wins.

    Args:
        inverse_depth: 1 / map units; 0 where unknown.
        camera: the pinhole of all views.
        T_ts: poses, camera of the map to target camera.

    Returns:
        Inverse depth in the target views, 0 where nothing is rendered. Without a gradient.
    """
    count, height, width = inverse_depth.shape
    q = inverse_depth.detach()
    y, x = torch.meshgrid(
        torch.arange(height, dtype=q.dtype, device=q.device),
        torch.arange(width, dtype=q.dtype, device=q.device),
        indexing="ij",
    )
    fx, fy, cx, cy = camera.params.to(q).unbind(-1)
    T_ts = T_ts.to(q)
    R, t = T_ts[:, :3, :3, None, None], T_ts[:, :3, 3, None, None]
    ray = R[:, :, 0] * ((x - cx) / fx) + R[:, :, 1] * ((y - cy) / fy) + R[:, :, 2] + t * q[:, None]  # times q
    is_known = (q > 0) & (ray[:, 2] > torch.finfo(q.dtype).eps)
    z = torch.where(is_known, ray[:, 2], 1.0)
    at_x, at_y = fx * ray[:, 0] / z + cx, fy * ray[:, 1] / z + cy
    q_target = torch.where(is_known, q / z, 0.0)
    rendered = q.new_zeros(count, height * width)
    for column in (at_x.floor(), at_x.floor() + 1):
        for row in (at_y.floor(), at_y.floor() + 1):
            is_inside = is_known & (column >= 0) & (column < width) & (row >= 0) & (row < height)
            place = torch.where(is_inside, row * width + column, 0.0).long().flatten(1)
            rendered.scatter_reduce_(1, place, torch.where(is_inside, q_target, 0.0).flatten(1), "amax")
    return rendered.unflatten(1, (height, width))


def as_seen_by(
    inverse_depth: Float[Tensor, "V H W"],
    others: Float[Tensor, "V H W"],
    camera: Camera,
    T_sr: Float[Tensor, "V 4 4"],
) -> Float[Tensor, "V H W"]:
    """Inverse depth of a view's pixels as other maps measure it, near given values.

    A pixel is projected into the other view with its depth; the other map's depth there, linear in inverse depth as
    on a plane, is brought back.

    Args:
        inverse_depth: of the view, one map for each other view.
        others: maps of the other views.
        camera: the pinhole of all views.
        T_sr: poses, camera of the view to those of the others.

    Returns:
        Inverse depth in the view, 0 where the other map has none.
    """
    T_sr = T_sr.to(others)
    q = inverse_depth.clamp(min=torch.finfo(others.dtype).eps)
    known = (others > 0).to(others.dtype)
    sampled, is_seen = (each[:, 0, 0] for each in warp(others[:, None], camera, T_sr[:, None], q[:, None]))
    share, _ = warp(known[:, None], camera, T_sr[:, None], q[:, None])
    is_seen = is_seen & (share[:, 0, 0] > 0.999) & (inverse_depth > 0) & (sampled > 0)
    height, width = others.shape[-2:]
    x = torch.arange(width, dtype=q.dtype, device=q.device)
    y = torch.arange(height, dtype=q.dtype, device=q.device)[:, None]
    fx, fy, cx, cy = camera.params.to(q).unbind(-1)
    R, t = T_sr[:, :3, :3, None, None], T_sr[:, :3, 3, None, None]
    # On the other view's ray the point moves by a factor k of its distance: k P_r + (k - 1) R^T t in the view's frame.
    z = R[:, 2, 0] * ((x - cx) / fx) + R[:, 2, 1] * ((y - cy) / fy) + R[:, 2, 2] + t[:, 2] * q
    k = q / (z * torch.where(is_seen, sampled, 1.0))
    back = (R[:, :, 2] * t).sum(1)
    z_back = k / q + (k - 1) * back
    is_seen = is_seen & (z_back > 0)
    return torch.where(is_seen, 1 / torch.where(is_seen, z_back, 1.0), 0.0)


def merge(
    inverse_depth: Float[Tensor, "H W"],
    confidence: Float[Tensor, "H W"],
    others: Float[Tensor, "V H W"],
    other_confidences: Float[Tensor, "V H W"],
    camera: Camera,
    T_sr: Float[Tensor, "V 4 4"],
    tolerance: float = TOLERANCE,
) -> Merged:
    """Merge the depth map of a view with those of its neighbors.

    The depth of every view is a candidate; the one with the most support is taken, with the mean of those that agree
    with it.

    Args:
        inverse_depth: of the view, 1 / map units; 0 where unknown.
        confidence: of its depth alone, 0 to 1: the weight of its votes.
        others, other_confidences: of its neighbors.
        camera: the pinhole of all views.
        T_sr: poses, camera of the view to those of the neighbors.
        tolerance: relative difference of depths at which one gives half a vote to another.
    """
    rendered = render(others, camera, se3_inverse(T_sr))
    maps = torch.cat((inverse_depth[None], as_seen_by(rendered, others, camera, T_sr)))
    sampled, _ = warp(other_confidences[:, None], camera, T_sr[:, None], rendered[:, None])
    weights = torch.cat((confidence[None], sampled[:, 0, 0]))
    weights = torch.where(maps > 0, weights, 0.0)

    def votes(candidate: Tensor) -> tuple[Tensor, Tensor]:
        relative = maps / torch.where(candidate > 0, candidate, 1.0) - 1
        square = (relative / tolerance).square()
        is_agreeing = (square <= 4) & (candidate > 0)
        return relative, torch.where(is_agreeing, weights / (1 + square), 0.0)

    best, support = torch.zeros_like(inverse_depth), torch.zeros_like(inverse_depth)
    for candidate in maps.unbind(0):
        found = votes(candidate)[1].sum(0)
        best, support = torch.where(found > support, candidate, best), torch.maximum(support, found)
    relative, given = votes(best)
    total = support.clamp(min=torch.finfo(maps.dtype).eps)
    mean = (given * relative).sum(0) / total
    spread = ((given * (relative - mean).square()).sum(0) / total).sqrt()
    is_in_front = (relative > 2 * tolerance) & (best > 0)
    return Merged(
        inverse_depth=best * (1 + mean),
        support=support,
        spread=spread,
        conflicts=torch.where(is_in_front, weights, 0.0).sum(0),
        agrees=(given[0] > 0).to(maps.dtype),
    )
