"""Depth of a view from other views with known poses: which ones, then planes are swept at half size, then at full size.

At half size every pixel chooses among all planes. At full size the hypotheses are a few steps around the surface found,
so that windows follow its slant, and the aggregation holds on to its shape.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.dense.cost_volume import (
    Aggregation,
    Minimum,
    find_minimum,
    implicit_change,
    inverse_depth_planes,
    matching_cost,
    position_std,
    semi_global,
)
from torchslam.geometry import Camera
from torchslam.geometry.estimate_gradients import needs_gradient
from torchslam.geometry.precision import without_autocast

PLANES = 64
"""Hypotheses at half size. Tried 64 to 128: 64.1 to 64.8 % of the pixels are within 5 % (experiments/dense)."""
STEPS = 4
"""Hypotheses at full size on either side of the surface found at half size."""
REFINEMENT = 0.5
"""Step at full size, in steps at half size."""
BEST_VIEWS = 3
"""Views that must match; the others may not see the surface."""
RADIUS = 3
"""Of the windows, pixels."""
BEST_ANGLE_DEG = 5.0
"""Parallax that is sought: less makes depth imprecise, more makes windows look different (MVSNet, Yao 2018)."""
BELOW_DEG, ABOVE_DEG = 1.0, 10.0
"""Standard deviations of the weight below and above the best angle, as there."""
LEAST_SHARED = 5
"""Points that two views must share: with fewer, their overlap is a guess."""


def neighbor_scores(
    points_w: Float[Tensor, "*batch N 3"],
    is_shared: Bool[Tensor, "*batch K N"],
    center_w: Float[Tensor, "*batch 3"],
    centers_w: Float[Tensor, "K 3"],
) -> Float[Tensor, "*batch K"]:
    """Score candidates by the points they share with a view and their parallax at each of them.

    Args:
        points_w: points that the view observes.
        is_shared: whether a candidate observes them too.
        center_w: camera center of the view.
        centers_w: camera centers of the candidates.

    Returns:
        Sum over the shared points of a weight of their parallax, 0 for candidates that share too few.
    """
    to_view = torch.nn.functional.normalize(center_w[..., None, :] - points_w, dim=-1)
    to_candidate = torch.nn.functional.normalize(centers_w[:, None] - points_w[..., None, :, :], dim=-1)
    cosine = (to_view[..., None, :, :] * to_candidate).sum(-1).clamp(-1, 1)
    angle = torch.rad2deg(torch.acos(cosine))
    sigma = torch.where(angle < BEST_ANGLE_DEG, BELOW_DEG, ABOVE_DEG).float()
    weight = torch.exp(-0.5 * ((angle - BEST_ANGLE_DEG) / sigma) ** 2)
    is_enough = is_shared.sum(-1) >= LEAST_SHARED
    return torch.where(is_enough, torch.where(is_shared, weight, 0.0).sum(-1), 0.0)


def choose_neighbors(
    scores: Float[Tensor, "*batch K"], count: int
) -> tuple[Int[Tensor, "*batch V"], Bool[Tensor, "*batch V"]]:
    """Choose the candidates of the highest scores, of equal ones the first.

    Returns:
        Their indices, best first, and whether there is such a candidate: its score is positive.
    """
    order = torch.sort(scores, dim=-1, descending=True, stable=True)
    return order.indices[..., :count], order.values[..., :count] > 0


class Estimate(NamedTuple):
    """Depth of views, and the values that determine its confidence.

    Attributes:
        inverse_depth: 1 / map units, positive.
        std: standard deviation of the inverse depth where it is right, 1 / map units; without a gradient.
        coarse: minimum of the cost at half size, of the pixels at full size; its position is in planes.
        match: matching cost at half size of the plane there, before the aggregation.
        fine: minimum at full size; its position is in steps.
    """

    inverse_depth: Float[Tensor, "B H W"]
    std: Float[Tensor, "B H W"]
    coarse: Minimum
    match: Float[Tensor, "B H W"]
    fine: Minimum


@without_autocast
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

    Gradients are those of `refine_depth`. The range of depth has none: the minimum does not depend on where it was
    looked for.

    Args:
        reference: gray images in [0, 1], of even width and height.
        sources: views to compare each with.
        camera: the pinhole of all views.
        T_sr: poses, reference camera to source camera.
        near, far: range of depth, map units.
        aggregate: aggregation of the costs.
        planes: number of planes of the sweep.
    """
    inverse_depths = inverse_depth_planes(near.to(reference), far.to(reference), planes).detach()
    step = inverse_depths[:, 1] - inverse_depths[:, 0]
    with torch.no_grad():
        small, small_sources = F.avg_pool2d(reference[:, None], 2)[:, 0], F.avg_pool2d(sources, 2)
        best = min(BEST_VIEWS, sources.shape[1])
        hypotheses = inverse_depths[..., None, None]
        cost = matching_cost(small, small_sources, halved(camera), T_sr, hypotheses, RADIUS, best)
        coarse = find_minimum(aggregate(cost, small))
        surface = inverse_depths[:, :1, None] + step[:, None, None] * coarse.position
        surface = F.interpolate(surface[:, None], size=reference.shape[-2:], mode="bilinear")[:, 0]
        match = cost.gather(1, coarse.position[:, None].round().long())[:, 0]
        coarse = Minimum(*(_doubled(each) for each in coarse))
    inverse_depth, fine = refine_depth(
        reference, sources, camera, T_sr, surface, REFINEMENT * step, 0.5 / far.to(reference), aggregate
    )
    with torch.no_grad():
        std = REFINEMENT * step[:, None, None] * position_std(fine)
    return Estimate(inverse_depth, std, coarse, _doubled(match), fine)


@without_autocast
def refine_depth(
    reference: Float[Tensor, "B H W"],
    sources: Float[Tensor, "B V H W"],
    camera: Camera,
    T_sr: Float[Tensor, "B V 4 4"],
    surface: Float[Tensor, "B H W"],
    step: Float[Tensor, " B"],
    least: Float[Tensor, " B"],
    aggregate: Aggregation = semi_global,
) -> tuple[Float[Tensor, "B H W"], Minimum]:
    """Find the inverse depth of the least cost near a surface.

    The inverse depth is differentiable with respect to images, poses and camera, by `implicit_change`: once, and where
    it is above `least`. It and the minimum are differentiable with respect to parameters of the aggregation.

    Args:
        reference, sources, camera, T_sr, aggregate: as for `estimate_depth`.
        surface: inverse depth to look around; without a gradient, as `step` and `least`.
        step: between hypotheses, of which there are STEPS on either side.
        least: inverse depth that no hypothesis lies below, positive.

    Returns:
        Inverse depth, and the minimum of the cost in steps.
    """
    with torch.no_grad():
        step, least = step[:, None, None], least[:, None, None]
        offsets = torch.arange(-STEPS, STEPS + 1, dtype=surface.dtype, device=surface.device)[:, None, None]
        hypotheses = torch.maximum(surface[:, None] + offsets * step[:, None], least[:, None])
        best = min(BEST_VIEWS, sources.shape[1])
        cost = matching_cost(reference, sources, camera, T_sr, hypotheses, RADIUS, best)
    found = find_minimum(aggregate(cost, reference.detach()))
    inverse_depth = surface.detach() + (found.position - STEPS) * step
    if needs_gradient(reference, sources, T_sr, camera.params):
        inverse_depth = inverse_depth + implicit_change(
            reference, sources, camera, T_sr, torch.maximum(inverse_depth, least), RADIUS, best
        )
    return torch.maximum(inverse_depth, least), found


def _doubled(values: Float[Tensor, "B H W"]) -> Float[Tensor, "B H2 W2"]:
    """Values at half size, of the pixels at full size."""
    return F.interpolate(values[:, None], scale_factor=2)[:, 0]


def halved(camera: Camera) -> Camera:
    """The pinhole for images of half the size, whose pixels are means of four."""
    fx, fy, cx, cy = camera.params.unbind(-1)
    params = torch.stack((fx / 2, fy / 2, (cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5), dim=-1)
    return Camera("pinhole", params, (camera.width // 2, camera.height // 2))
