"""Depth of a view from others with known poses: a sweep at half size, refined at full size."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchslam.dense.aggregation import Aggregation, semi_global
from torchslam.dense.cost_volume import inverse_depth_planes, matching_cost
from torchslam.dense.minimum import find_minimum
from torchslam.geometry import Camera

PLANES = 96
OFFSETS = 4
FINE = 0.5


class Estimate(NamedTuple):
    inverse_depth: Tensor
    cost: Tensor
    curvature: Tensor
    margin: Tensor
    coarse_cost: Tensor
    coarse_margin: Tensor
    step: Tensor


def halved(camera: Camera) -> Camera:
    fx, fy, cx, cy = camera.params.unbind(-1)
    params = torch.stack((fx / 2, fy / 2, (cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5), -1)
    return Camera("pinhole", params, (camera.width // 2, camera.height // 2))


def estimate(reference, sources, camera, T_sr, near, far, aggregate: Aggregation = semi_global, planes=PLANES, offsets=OFFSETS, fine=FINE, num_best=2, coarse_radius=2, radius=3, rounds=1, fine_aggregate=None):
    half = halved(camera)
    small = F.avg_pool2d(reference[..., None, :, :], 2)[..., 0, :, :]
    q = inverse_depth_planes(near, far, planes)
    step = q[..., 1] - q[..., 0]
    cost = matching_cost(small, F.avg_pool2d(sources, 2), half, T_sr, q[..., None, None], coarse_radius, num_best)
    coarse = find_minimum(aggregate(cost, small))
    surface = q[..., 0, None, None] + step[..., None, None] * coarse.position
    up = lambda x: F.interpolate(x[:, None], size=reference.shape[-2:], mode="nearest")[:, 0]
    surface = F.interpolate(surface[:, None], size=reference.shape[-2:], mode="bilinear")[:, 0]
    for _ in range(rounds):
        fine_step = step * fine
        o = torch.arange(-offsets, offsets + 1, dtype=q.dtype, device=q.device)
        hyp = surface[..., None, :, :] + (o * fine_step[..., None])[..., None, None]
        hyp = hyp.clamp(min=1e-6)
        cost = matching_cost(reference, sources, camera, T_sr, hyp, radius, num_best)
        found = find_minimum((fine_aggregate or aggregate)(cost, reference))
        surface = surface + (found.position - offsets) * fine_step[..., None, None]
        fine = fine / 2
    return Estimate(surface, found.cost, found.curvature, found.margin, up(coarse.cost), up(coarse.margin), fine_step)
