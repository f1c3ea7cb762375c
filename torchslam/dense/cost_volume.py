"""Plane sweep: how well the views agree with each depth hypothesis of each pixel of the reference view.

A hypothesis is an inverse depth, 1 / z, per pixel: constant over the image for a sweep of planes, or around a known
surface for a refinement, whose windows then follow the surface. Everything is differentiable with respect to images,
poses, camera and hypotheses; whether a pixel is seen, and which views are the best ones, are decisions without a
gradient.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry import Camera

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

    Args:
        sources: gray images.
        camera: the pinhole of all views.
        T_sr: poses, reference camera to source camera.
        inverse_depth: hypotheses, 1 / map units.

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
        reference, sources: gray images in [0, 1].
        camera: the pinhole of all views.
        T_sr: poses, reference camera to source camera.
        inverse_depth: hypotheses, 1 / map units.
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
