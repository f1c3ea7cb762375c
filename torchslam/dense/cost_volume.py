"""A cost volume: how well the views agree with each depth hypothesis of each pixel, its aggregation and its minimum.

Plane sweep: a hypothesis is an inverse depth, 1 / z, per pixel: constant over the image for a sweep of planes, or
around a known surface for a refinement, whose windows then follow the surface. Costs are differentiable with respect to
images, poses, camera and hypotheses; whether a pixel is seen, and which views are the best ones, are decisions without
a gradient. The gradient of depth comes from `implicit_change`, not from costs: between two pixels these are as bent as
the interpolation, not as the image, and the penalties of an aggregation hold their minimum where it is.
Images are gray, in [0, 1]; `camera` is the pinhole of all views, T_sr are poses from the
reference camera to source cameras, and inverse depths are in 1 / map units.

Semi-global aggregation (Hirschmüller 2008): smooth surfaces that may jump at edges of the image. A path comes to every
pixel along each direction; its cost is the cost of the pixel and of the cheapest changes of hypothesis on the way. A
change by one costs SMALL_STEP, which slanted surfaces need; any other one costs JUMP, or less where the image has an
edge.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry import Camera
from torchslam.geometry.estimate_gradients import first_order

NOISE = 1.5 / 255
"""Standard deviation of image noise, added to that of every window: where the texture is weaker, nothing correlates."""
BLOCK = 1 << 21
"""Numbers of a tensor that is computed at once, so that memory is bounded whatever the number of hypotheses."""


def inverse_depth_planes(
    near: Float[Tensor, "*batch"], far: Float[Tensor, "*batch"], count: int
) -> Float[Tensor, "*batch count"]:
    """Planes at equal steps of inverse depth, from far to near: equal steps of disparity."""
    steps = torch.linspace(0, 1, count, dtype=near.dtype, device=near.device)
    return 1 / far[..., None] + (1 / near - 1 / far)[..., None] * steps


def warp(
    sources: Float[Tensor, "*batch V H W"],
    camera: Camera,
    T_sr: Float[Tensor, "*batch V 4 4"],
    inverse_depth: Float[Tensor, "*batch D #H #W"],
) -> tuple[Float[Tensor, "*batch V D H W"], Bool[Tensor, "*batch V D H W"]]:
    """Sample the source views where the reference view's pixels are seen at given inverse depths.

    Returns:
        Samples, and whether the pixel is in front of the source camera and inside of its image. Samples that are not
        seen are finite and mean nothing.
    """
    height, width = sources.shape[-2:]
    T_sr, camera = T_sr.to(sources), camera.to(sources)
    x = torch.arange(width, dtype=sources.dtype, device=sources.device)
    y = torch.arange(height, dtype=sources.dtype, device=sources.device)
    fx, fy, cx, cy = (each[..., None, None, None] for each in camera.params.unbind(-1))
    ray_x, ray_y = (x - cx) / fx, (y[:, None] - cy) / fy  # (*batch 1 1 W), (*batch 1 H 1)
    R, t = T_sr[..., :3, :3, None, None], T_sr[..., :3, 3, None, None, None]
    # A point at inverse depth q is seen along R ray + q t.
    rays = R[..., 0, :, :] * ray_x + R[..., 1, :, :] * ray_y + R[..., 2, :, :]
    q = inverse_depth[..., None, :, :, :]
    z = torch.addcmul(rays[..., 2, None, :, :], q, t[..., 2, :, :, :])
    is_seen = z > torch.finfo(z.dtype).eps
    inverse_z = torch.where(is_seen, z, 1.0).reciprocal()
    grid = []
    for axis, (focal, center, size) in enumerate(((fx, cx, width), (fy, cy, height))):
        # grid_sample counts from -1 to 1 between the centers of the outermost pixels, with align_corners.
        a, b = focal * (2 / (size - 1)), center * (2 / (size - 1)) - 1
        fixed = a * rays[..., axis, :, :] + b * rays[..., 2, :, :]
        moving = a[..., None] * t[..., axis, :, :, :] + b[..., None] * t[..., 2, :, :, :]
        at = torch.addcmul(fixed[..., None, :, :], q, moving) * inverse_z
        is_seen = is_seen & (at.abs() <= 1)
        grid.append(at)
    flat = torch.stack(grid, dim=-1)
    shape = flat.shape[:-1]
    samples = F.grid_sample(
        sources.reshape(-1, 1, height, width),
        flat.reshape(-1, shape[-3] * shape[-2], width, 2),
        padding_mode="border",
        align_corners=True,
    )
    return samples.reshape(shape), is_seen


def box_sum(images: Float[Tensor, "*batch H W"], radius: int) -> Float[Tensor, "*batch H W"]:
    """Sum over a square of 2 radius + 1 pixels; 0 is beyond the edge. Cost does not depend on the radius."""
    for dim in (-1, -2):
        pad = (radius + 1, radius) if dim == -1 else (0, 0, radius + 1, radius)
        sums = F.pad(images, pad).cumsum(dim)
        size = images.shape[dim]
        images = sums.narrow(dim, 2 * radius + 1, size) - sums.narrow(dim, 0, size)
    return images


def correlation(
    reference: Float[Tensor, "*#batch H W"], samples: Float[Tensor, "*#batch H W"], radius: int
) -> Float[Tensor, "*#batch H W"]:
    """Zero-mean normalized cross-correlation of windows, -1 to 1; near 0 where the texture is as weak as the noise."""
    ones = box_sum(torch.ones_like(reference), radius)
    mean_r, mean_s = box_sum(reference, radius) / ones, box_sum(samples, radius) / ones
    var_r = box_sum(reference * reference, radius) / ones - mean_r * mean_r
    var_s = box_sum(samples * samples, radius) / ones - mean_s * mean_s
    cov = box_sum(reference * samples, radius) / ones - mean_r * mean_s
    floor = NOISE * NOISE
    return cov * ((var_r.clamp(min=0) + floor) * (var_s.clamp(min=0) + floor)).rsqrt()


def mean_of_best(scores: Float[Tensor, "V *batch"], count: int) -> Float[Tensor, "*batch"]:
    """Mean of the `count` highest scores of each column; gradients flow to those."""
    best: list[Tensor] = []
    for row in scores.unbind(0):
        for place, kept in enumerate(best):
            best[place], row = torch.maximum(kept, row), torch.minimum(kept, row)
        if len(best) < count:
            best.append(row)
    return torch.stack(best).mean(0) if len(best) > 1 else best[0]


def matching_cost(
    reference: Float[Tensor, "*batch H W"],
    sources: Float[Tensor, "*batch V H W"],
    camera: Camera,
    T_sr: Float[Tensor, "*batch V 4 4"],
    inverse_depth: Float[Tensor, "*batch D #H #W"],
    radius: int,
    num_best: int,
) -> Float[Tensor, "*batch D H W"]:
    """Matching cost of hypotheses: 1 - mean correlation of the best views, from 0 to 2; 1 without any information.

    The best views are taken because a surface may be hidden in some. A view that does not see the pixel correlates
    with 0.

    Args:
        reference, sources, camera, T_sr, inverse_depth: as in `warp`.
        radius: of the windows, pixels.
        num_best: number of views to take, for each hypothesis.
    """
    # Correlation does not depend on the mean; sums of small numbers are more precise.
    mean = reference.detach().mean((-1, -2), keepdim=True)
    reference, sources = reference - mean, sources - mean[..., None, :, :]
    size = max(1, BLOCK // sources.numel())
    costs = []
    for block in inverse_depth.split(size, dim=-3):
        samples, is_seen = warp(sources, camera, T_sr, block)
        scores = correlation(reference[..., None, None, :, :], samples, radius)
        scores = torch.where(is_seen, scores, 0.0)
        costs.append(1 - mean_of_best(scores.movedim(-4, 0), num_best))
    return torch.cat(costs, dim=-3)


def implicit_change(
    reference: Float[Tensor, "*batch H W"],
    sources: Float[Tensor, "*batch V H W"],
    camera: Camera,
    T_sr: Float[Tensor, "*batch V 4 4"],
    inverse_depth: Float[Tensor, "*batch H W"],
    radius: int,
    num_best: int,
) -> Float[Tensor, "*batch H W"]:
    """A change of inverse depth, of value zero, that carries the gradient of the minimum of the matching cost.

    It is a Gauss-Newton step at the minimum, which differentiates it implicitly: in windows, a change of the samples
    less that of the reference is expressed by what a change of inverse depth does to the samples. As in `correlation`,
    brightness and contrast of a window are free. Windows around a pixel count by their texture, as held weights of
    the aggregation; the best views are those at the minimum. Where nothing correlates, the gradient is zero. There are
    no second derivatives.

    Args:
        reference, sources, camera, T_sr, radius, num_best: as in `matching_cost`.
        inverse_depth: at the minimum; without a gradient.
    """

    def mean(images: Tensor) -> Tensor:
        return box_sum(images, radius) / count

    def covariance(one: Tensor, other: Tensor) -> Tensor:
        return mean(one * other) - mean(one) * mean(other)

    gray = reference.detach().mean((-1, -2), keepdim=True)
    reference, sources = (reference - gray)[..., None, :, :], sources - gray[..., None, :, :]
    count = box_sum(torch.ones_like(reference), radius)
    views = sources.shape[-3]
    at = inverse_depth.detach()[..., None, None, None, :, :]
    at = at.expand(*sources.shape[:-2], 1, 1, *sources.shape[-2:]).contiguous().requires_grad_()
    with torch.enable_grad():
        samples, is_seen = warp(sources[..., None, :, :], camera, T_sr[..., None, :, :], at[..., 0, :, :])
    (slope,) = torch.autograd.grad(samples.sum(), at, retain_graph=True)
    samples, is_seen, slope = (each[..., 0, 0, :, :] for each in (samples, is_seen, slope))
    fixed, floor = samples.detach(), NOISE * NOISE
    var_s = covariance(fixed, fixed).clamp(min=0) + floor
    with torch.no_grad():
        var_r = covariance(reference, reference).clamp(min=0) + floor
        scores = torch.where(is_seen, correlation(reference, fixed, radius), 0.0)
        is_best = torch.zeros_like(is_seen).scatter(
            -3, scores.topk(min(num_best, views), dim=-3).indices, True
        )
        weights = torch.where(is_best & is_seen, 1 / var_s, 0.0)
        contrast = covariance(slope, fixed) / var_s
        normal = weights * (covariance(slope, slope) - contrast * covariance(slope, fixed))
        normal = box_sum(normal.sum(-3), radius)

    def along(images: Tensor) -> Tensor:
        """How much of a change of the windows is like that by a change of inverse depth."""
        return covariance(slope, images) - contrast * covariance(fixed, images)

    change = along(samples) - (var_s / var_r).sqrt() * along(reference)
    change = box_sum((weights * change).sum(-3), radius)
    is_known = normal * inverse_depth.detach() ** 2 > torch.finfo(normal.dtype).eps  # whatever the unit
    change = torch.where(is_known, -change / torch.where(is_known, normal, 1.0), 0.0)
    return first_order(change - change.detach())


STD_FACTOR = 0.61
"""Measured on a rendered room; 0.55 to 0.69 in each eighth of the pixels, by the deviation."""


class Minimum(NamedTuple):
    """The minimum of the cost of each pixel.

    Attributes:
        position: of the minimum, in steps from the first hypothesis, between the hypotheses.
        cost: at the best hypothesis.
        curvature: second difference of the cost there; 0 at the first and the last hypothesis.
        margin: how much more the best hypothesis that is not next to it costs.
    """

    position: Float[Tensor, "*batch H W"]
    cost: Float[Tensor, "*batch H W"]
    curvature: Float[Tensor, "*batch H W"]
    margin: Float[Tensor, "*batch H W"]


def find_minimum(cost: Float[Tensor, "*batch D H W"]) -> Minimum:
    """Find the minimum of each pixel on the parabola through the best hypothesis and its neighbors.

    Differentiable with respect to the cost; which hypothesis is the best one is a decision without a gradient.
    """
    planes = cost.shape[-3]
    least, best = cost.min(dim=-3, keepdim=True)
    below = cost.gather(-3, (best - 1).clamp(min=0))
    above = cost.gather(-3, (best + 1).clamp(max=planes - 1))
    is_inside = (best > 0) & (best < planes - 1)
    curvature = torch.where(is_inside, below - 2 * least + above, 0.0)
    has_minimum = curvature > torch.finfo(cost.dtype).eps
    offset = torch.where(has_minimum, 0.5 * (below - above) / torch.where(has_minimum, curvature, 1.0), 0.0)
    hypotheses = torch.arange(planes, device=cost.device)[:, None, None]
    others = cost.masked_fill((hypotheses - best).abs() <= 1, torch.inf).amin(dim=-3, keepdim=True)
    margin = torch.where(torch.isfinite(others), others - least, 0.0)
    return Minimum(*(each.squeeze(-3) for each in (best + offset, least, curvature, margin)))


def position_std(found: Minimum) -> Float[Tensor, "*batch H W"]:
    """Standard deviation of the position of a minimum, in steps; infinite where the cost has no curvature.

    The cost left at the minimum is the variance of what does not match, and its curvature is the square of what the
    images change by in a step: their ratio is the variance of the position (the bound of Cramér and Rao). It holds
    where the minimum is the right one; errors of the poses come on top.
    """
    has_minimum = found.curvature > torch.finfo(found.curvature.dtype).eps
    ratio = found.cost.clamp(min=0) / torch.where(has_minimum, found.curvature, 1.0)
    return torch.where(has_minimum, STD_FACTOR * ratio.sqrt(), torch.inf)


Aggregation = Callable[[Tensor, Tensor], Tensor]
"""From costs (*batch, D, H, W) and the gray image (*batch, H, W) to aggregated costs of the same shape."""

SMALL_STEP = 0.1
"""Cost of a change by one hypothesis, in units of the matching cost. Tried 0.025 to 0.1: 63.5 to 67.9 % of the pixels
are within 5 % (experiments/dense)."""
JUMP = 1.2
"""Cost of any larger change. Tried 0.3 to 1.2, in proportion to `SMALL_STEP`."""
LEAST_JUMP = 0.1
"""Cost of a jump at the strongest edge: that of a small step."""
EDGE = 10 / 255
"""Difference of gray values of two pixels at which a jump costs half of JUMP."""


def semi_global(
    cost: Float[Tensor, "*batch D H W"],
    image: Float[Tensor, "*batch H W"],
    small_step: float = SMALL_STEP,
    jump: float = JUMP,
) -> Float[Tensor, "*batch D H W"]:
    """Aggregate a cost volume along eight directions.

    Args:
        cost: matching costs, in the order of the hypotheses.
        image: gray image in [0, 1] of the same pixels.
        small_step, jump: costs of a change by one hypothesis, and by more.

    Returns:
        The mean cost of the paths that come to each pixel. Differentiable with respect to the cost; the image only
        decides what a jump costs.
    """
    batch, (planes, height, width) = cost.shape[:-3], cost.shape[-3:]
    cost, image = cost.reshape(-1, planes, height, width), image.detach().reshape(-1, height, width)
    total = _paths(cost, image, (0,), small_step, jump)
    across = _paths(cost.mT, image.mT, (-1, 0, 1), small_step, jump)
    return ((total + across.mT) / 8).reshape(*batch, planes, height, width)


def _paths(cost: Tensor, image: Tensor, shifts: tuple[int, ...], small_step: float, jump: float) -> Tensor:
    """Sum of the costs (B, D, H, W) of paths from column to column, both ways, that move by each shift of rows."""
    # Columns first, hypotheses last; the two ways beside each other.
    columns = torch.stack((cost, cost.flip(-1))).permute(4, 0, 1, 3, 2).contiguous()  # (W, 2, B, H, D)
    pixels = torch.stack((image, image.flip(-1))).permute(3, 0, 1, 2)  # (W, 2, B, H)
    total = torch.zeros_like(columns)
    for shift in shifts:
        before = pixels.roll((1, shift), (0, 3))
        jumps = jump / (1 + (pixels - before).abs() / EDGE)[..., None]
        path, along = columns[0], [columns[0]]
        for column, penalty in zip(columns[1:], jumps[1:], strict=True):
            if shift:  # by a row; a path that begins at the edge costs nothing so far
                kept = path[..., :-1, :] if shift > 0 else path[..., 1:, :]
                path = F.pad(kept, (0, 0, 1, 0) if shift > 0 else (0, 0, 0, 1))
            path = _step(path, column, penalty, small_step)
            along.append(path)
        total = total + torch.stack(along)
    total = total.permute(1, 2, 4, 3, 0)
    return total[0] + total[1].flip(-1)


def _step(path: Tensor, cost: Tensor, jump: Tensor, small_step: float) -> Tensor:
    """Costs of paths one pixel further on; the least one so far is subtracted, so that they do not grow."""
    least = path.amin(-1, keepdim=True)
    near = F.pad(path + small_step, (1, 1), value=torch.inf)
    best = torch.minimum(near[..., :-2], near[..., 2:])
    best = torch.minimum(torch.minimum(best, path), least + jump.clamp(min=LEAST_JUMP))
    return cost + best - least
