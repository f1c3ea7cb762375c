"""Depth that several views agree on: maps of neighbors are rendered into a view, compared with its own and merged.

How probable it is that a depth is right within 5 % is given by logistic models, whose weights are those of largest
likelihood on the sensor's depth of a handheld indoor recording and on the exact depth of a rendered room, of equal
weight; `experiments/dense/README.md` has their accuracy. Normals are those of planes fitted to inverse depth, which is
linear in the pixel on a plane; `kornia.geometry.depth_to_normals` differentiates depth between the next pixels, so that
its normals are as noisy as the depth, and wrong beside pixels without one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.dense.cost_volume import warp
from torchslam.dense.estimate import Estimate
from torchslam.geometry import Camera, se3_inverse

TOLERANCE = 0.02
"""Relative difference of depths at which one gives half a vote to another; from twice as much on, none."""
ALONE = (-1.67, 7.88, -1.03, 2.27, 0.97)
"""Weights of the cost and the margin at full size, of those at half size, and the constant."""
TOGETHER = (1.15, -0.66, -0.45, 0.40, 0.68)
"""Weights of the logarithm of the support, of the relative spread in percent, of the conflicts and of the view's own
log-odds where it agrees, and the constant."""
LEAST_SUPPORT = 1e-3
"""Least support that counts, as `LEAST_ALONE`."""
LEAST_ALONE = 1e-4
"""Below these, evidence does not count any further."""
LEAST_KEPT = 0.72
"""Least confidence of depth that is kept: then about nine in ten of all kept pixels are right."""
SPECK = 2
"""Radius of the neighborhood most of which must be kept, pixels."""
NORMAL_RADIUS = 3
"""Of the windows that planes are fitted to, pixels."""
EDGE = 0.05
"""Relative difference of depths from which on a pixel belongs to another surface."""
LEAST_SHARE = 0.3
"""Of a window that must be known."""


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
        camera, T_sr: pinhole of all views; poses from the camera of the view to those of the others.

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
        camera, T_sr: pinhole of all views; poses from the camera of the view to those of the neighbors.
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


def alone_features(found: Estimate) -> Float[Tensor, "B H W 4"]:
    """What a view alone knows: cost and margin of the two minima."""
    return torch.stack((found.fine.cost, found.fine.margin, found.coarse.cost, found.coarse.margin), dim=-1)


def confidence_alone(found: Estimate) -> Float[Tensor, "B H W"]:
    """Probability that the depth of a view is right, before it is compared with others."""
    return _logistic(alone_features(found), ALONE)


def together_features(merged: Merged, alone: Float[Tensor, "H W"]) -> Float[Tensor, "H W 4"]:
    """What the comparison of the views adds."""
    own = merged.agrees * torch.logit(alone, LEAST_ALONE)
    support = merged.support.clamp(min=LEAST_SUPPORT).log()
    return torch.stack((support, 100 * merged.spread, merged.conflicts, own), dim=-1)


def confidence_together(merged: Merged, alone: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Probability that merged depth is right; 0 where there is none."""
    return torch.where(merged.inverse_depth > 0, _logistic(together_features(merged, alone), TOGETHER), 0.0)


def kept(confidence: Float[Tensor, "H W"], least: float = LEAST_KEPT) -> Bool[Tensor, "H W"]:
    """Whether depth is kept: it is probable enough, and so is most of what is around it, which specks are not."""
    is_probable = confidence >= least
    share = F.avg_pool2d(is_probable.to(confidence.dtype)[None, None], 2 * SPECK + 1, 1, SPECK)[0, 0]
    return is_probable & (share > 0.5)


def _logistic(features: Tensor, weights: tuple[float, ...]) -> Tensor:
    slope = torch.tensor(weights[:-1], dtype=features.dtype, device=features.device)
    return torch.sigmoid(features @ slope + weights[-1])


def depth_normals(
    depth: Float[Tensor, "B H W"], camera: Camera, radius: int = NORMAL_RADIUS
) -> Float[Tensor, "B 3 H W"]:
    """Compute unit normals in the camera frame, facing the camera; 0 where they or the depth are unknown.

    Differentiable with respect to depth and camera.
    """
    is_known = depth > 0
    q = torch.where(is_known, 1 / torch.where(is_known, depth, 1.0), 0.0)
    size = 2 * radius + 1
    height, width = depth.shape[-2:]

    def windows(values: Tensor) -> Tensor:
        return F.unfold(values[:, None], size, padding=radius).unflatten(-1, (height, width))

    around = windows(q)
    weight = ((around > 0) & ((around - q[:, None]).abs() <= EDGE * q[:, None])).to(q.dtype)
    offset = torch.arange(-radius, radius + 1, dtype=q.dtype, device=q.device)
    y, x = (each.flatten() for each in torch.meshgrid(offset, offset, indexing="ij"))
    # Least squares of q - q0 = a x + b y + c: the three moments of the window, centered.
    moments = torch.stack((torch.ones_like(x), x, y, x * x, y * y, x * y))
    sums = torch.einsum("mp,bphw->mbhw", moments, weight)
    total = sums[0].clamp(min=1)
    mean_x, mean_y, xx, yy, xy = sums[1:] / total
    sums = torch.einsum("mp,bphw->mbhw", moments[:3], weight * (around - q[:, None]))
    mean_q, xq, yq = sums / total
    xx, yy, xy = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    xq, yq = xq - mean_x * mean_q, yq - mean_y * mean_q
    determinant = xx * yy - xy * xy
    is_known = is_known & (total >= LEAST_SHARE * size**2) & (determinant > 0.1)
    safe = torch.where(is_known, determinant, 1.0)
    a, b = (yy * xq - xy * yq) / safe, (xx * yq - xy * xq) / safe
    # On the plane n X = 1 inverse depth is n (ray): n_x = fx a, n_y = fy b, and n_z makes it q at the pixel itself.
    fx, fy, cx, cy = (each[..., None, None] for each in camera.params.to(q).unbind(-1))
    row = torch.arange(height, dtype=q.dtype, device=q.device)[:, None]
    column = torch.arange(width, dtype=q.dtype, device=q.device)
    n_z = q + mean_q - a * (column + mean_x - cx) - b * (row + mean_y - cy)
    plane = torch.stack((fx * a, fy * b, n_z), dim=1)
    plane = torch.where(is_known[:, None], plane, plane.new_tensor((0.0, 0.0, 1.0))[:, None, None])
    # n X = 1 > 0 points away from the camera.
    return torch.where(is_known[:, None], -F.normalize(plane, dim=1), 0.0)
