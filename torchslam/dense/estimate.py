"""Depth of a view from other views with known poses: planes are swept at half size, then depth is refined at full size.

At half size every pixel chooses among all planes. At full size the hypotheses are a few steps around the surface found,
so that windows follow its slant, and the aggregation holds on to its shape.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchslam.dense.aggregation import Aggregation, semi_global
from torchslam.dense.cost_volume import inverse_depth_planes, matching_cost
from torchslam.dense.minimum import Minimum, find_minimum
from torchslam.geometry import Camera

PLANES = 64
STEPS = 4
"""Hypotheses at full size on either side of the surface found at half size."""
REFINEMENT = 0.5
"""Step at full size, in steps at half size."""
BEST_VIEWS = 3
"""Views that must match; the others may not see the surface."""
HALF_RADIUS, FULL_RADIUS = 3, 3
"""Radii of the windows, pixels."""
MIN_SIZE = 32
"""Smallest side of an image, pixels: windows at half size are a fraction of it."""


class Estimate(NamedTuple):
    """Depth of views, and what tells how certain it is.

    Attributes:
        inverse_depth: 1 / map units, positive.
        sigma: its standard deviation by the curvature of the cost, 1 / map units: how well the place of the minimum is
            known if it is the right one.
        coarse: minimum of the cost at half size, of the pixels at full size; its position is in planes.
        fine: minimum at full size; its position is in steps.
    """

    inverse_depth: Float[Tensor, "B H W"]
    sigma: Float[Tensor, "B H W"]
    coarse: Minimum
    fine: Minimum


def estimate_depth(
    reference: Float[Tensor, "B H W"],
    sources: Float[Tensor, "B V H W"],
    camera: Camera,
    T_sr: Float[Tensor, "B V 4 4"],
    near: Float[Tensor, " B"],
    far: Float[Tensor, " B"],
    aggregate: Aggregation = semi_global,
    planes: int = PLANES,
) -> Estimate:
    """Estimate the depth of every pixel of reference views.

    Differentiable with respect to images, poses and camera through the cost around the minimum. Detached are the range
    of depth, the surface found at half size, which only says where to look, and which hypothesis is the best one.

    Args:
        reference: gray images in [0, 1], of even width and height.
        sources: views to compare each with.
        camera: the pinhole of all views.
        T_sr: poses, reference camera to source camera.
        near, far: range of depth, map units.
        aggregate: aggregation of the costs.
        planes: number of planes of the sweep.
    """
    best = min(BEST_VIEWS, sources.shape[1])
    inverse_depths = inverse_depth_planes(near.to(reference), far.to(reference), planes)
    step = (inverse_depths[:, 1] - inverse_depths[:, 0])[:, None, None]
    with torch.no_grad():
        small, small_sources = F.avg_pool2d(reference[:, None], 2)[:, 0], F.avg_pool2d(sources, 2)
        hypotheses = inverse_depths[..., None, None]
        cost = matching_cost(small, small_sources, halved(camera), T_sr, hypotheses, HALF_RADIUS, best)
        coarse = find_minimum(aggregate(cost, small))
        surface = inverse_depths[:, :1, None] + step * coarse.position
        surface = F.interpolate(surface[:, None], size=reference.shape[-2:], mode="bilinear")
        coarse = Minimum(*(F.interpolate(each[:, None], scale_factor=2)[:, 0] for each in coarse))
    step = REFINEMENT * step
    offsets = torch.arange(-STEPS, STEPS + 1, dtype=surface.dtype, device=surface.device)[:, None, None]
    # No hypothesis lies at infinity or beyond.
    hypotheses = (surface + offsets * step[:, None]).clamp(min=0.5 / far.to(surface).amax())
    cost = matching_cost(reference, sources, camera, T_sr, hypotheses, FULL_RADIUS, best)
    fine = find_minimum(aggregate(cost, reference))
    inverse_depth = (surface[:, 0] + (fine.position - STEPS) * step).clamp(min=0.5 / far.to(surface).amax())
    return Estimate(inverse_depth, _sigma(fine, step), coarse, fine)


def _sigma(found: Minimum, step: Tensor) -> Tensor:
    """Standard deviation of the place of a minimum: a parabola of that curvature rises by the cost of the minimum."""
    ratio = found.cost.clamp(min=0) / found.curvature.clamp(min=1e-3)
    return step * ratio.clamp(max=STEPS**2).sqrt()


def halved(camera: Camera) -> Camera:
    """The pinhole for images of half the size, whose pixels are means of four."""
    fx, fy, cx, cy = camera.params.unbind(-1)
    params = torch.stack((fx / 2, fy / 2, (cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5), dim=-1)
    return Camera("pinhole", params, (camera.width // 2, camera.height // 2))
