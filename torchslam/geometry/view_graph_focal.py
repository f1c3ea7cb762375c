"""The focal length that makes essential matrices of the fundamental matrices of many pairs of images.

With the right focal length f and K = diag(f, f, 1), E = K^T F K has two equal singular values: in the planes
perpendicular to its null vectors it is a rotation, or a reflection. These are two equations for each pair, linear in F,
and their noise follows from that of F. A focal length is judged by what they are worth in units of that noise, so that
pairs without information about it, whose equations hold or are uncertain with any, do not count.

Sources: Sweeney et al., "Optimizing the viewing graph for structure-from-motion", 2015; Fetzer et al., "Stable
intrinsic auto-calibration from fundamental matrices of devices with uncorrelated camera parameters", 2020; Pan et al.,
"Global structure-from-motion revisited", 2024. The noise model is ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.estimate_gradients import implicit_step, needs_gradient
from torchslam.geometry.fundamental import homography_share, refine_fundamental
from torchslam.geometry.lie import homogeneous
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import NORMAL_SQUARED_MEDIAN_2D, robustify, weighted_median
from torchslam.geometry.two_view import tangent_basis

# Of the focal length, in longer sides of the image: 118 to 14 degrees of view along that side.
RANGE = 0.3, 4.0
_GRID = 300  # focal lengths in that range: steps of 0.9 %, below the width that one pair's minimum can have
# Standard deviation of the nine numbers of F, at norm one and in longer sides, by what no model has: rolling shutter,
# the rest of the distortion, moving things. Without it, a few pairs of very many matches decide. On nine recordings,
# 1e-4 to 2e-3 were tried: the root mean square error of the focal length falls from 2.4 to 1.3 %. Small motions are
# lost in it, such as of a drone that circles its object; with 1e-4 as well, these give focal lengths off by 15 %.
_MODEL_NOISE = 1e-3
_KERNEL_SCALE = 1.5  # deviations of the noise at which a pair begins to count less; 1 to 3 were tried

_ROUNDING = 1e-12  # of the cost and of its minimum: the resolution of Newton's method
_MAX_STD = 0.1  # relative; beyond it a focal length counts as unknown
_RISE = 9.0  # of the cost, three deviations, that any focal length further away than three times `_MAX_STD` must have
_MIN_MATCHES = 20  # of a pair: the noise of fewer cannot be told
# Of the matches, that one homography explains: pairs beyond it have no information, however certain their matrix seems.
# Planes and rotating cameras with simulated noise have 0.92 to 1. Of the pairs of each of nine recordings, 90 % have
# less than 0.75, most half of that.
_MAX_HOMOGRAPHY_SHARE = 0.8


@dataclass(frozen=True)
class ViewGraphFocal:
    """The focal length of M pairs of images of one camera.

    Attributes:
        focal: pixels, with gradient; without `success` the best of the range all the same, without gradient.
        std: relative standard error; infinite where the cost has no minimum. The largest of what the noise and the
            disagreement of the pairs give.
        errors: of each pair at that focal length, in standard deviations of its noise, which the disagreement of the
            pairs enlarges; NaN for pairs without weight.
        inliers: pairs in use whose error noise explains.
        success: whether the pairs determine the focal length, to about a tenth.
        k1: the radial distortion that comes with it (OpenCV); zero where that is not sought.
    """

    focal: Float[Tensor, ""]
    std: Float[Tensor, ""]
    errors: Float[Tensor, " M"]
    inliers: Bool[Tensor, " M"]
    success: Bool[Tensor, ""]
    k1: Float[Tensor, ""]


@full_precision
def focal_from_fundamentals(
    F_21: Float[Tensor, "M 3 3"],
    principal_point: Float[Tensor, "2"],
    size: tuple[int, int],
    weights: Float[Tensor, " M"] | None = None,
) -> ViewGraphFocal:
    """Find the focal length of a camera without distortion from the fundamental matrices of pairs of its images.

    All nine numbers of a matrix count as equally uncertain. Matrices of a plane or of a camera that only turned are
    arbitrary: leave them out, or use `focal_from_pairs`, which sees that they have no information. Pure forward
    motion has none either, nor have optical axes that meet at the same distance from both views, as those of a camera
    that circles what it looks at: then there is no `success`.

    Args:
        F_21: in pixels, x_2^T F_21 x_1 = 0, of any scale and of rank two; one that is not finite is left out.
        principal_point: pixels.
        size: width and height of the images, pixels; sets the range of the search.
        weights: of the pairs, not negative, as if each were present that many times; one by default.

    Returns:
        The focal length, with the gradient to F_21 and weights of the minimum, the noise level fixed.
    """
    F, weights = _scaled(F_21, principal_point, size, weights)
    F = F / F.flatten(1).norm(dim=1)[:, None, None]
    nothing = F.new_zeros(len(F), 9)
    graph = _Graph(F, torch.diag_embed(nothing), nothing, weights)
    return _solve(graph, 0.0, size, F_21.dtype)


@full_precision
def focal_from_pairs(
    F_21: Float[Tensor, "M 3 3"],
    pixels_1: Float[Tensor, "M N 2"],
    pixels_2: Float[Tensor, "M N 2"],
    mask: Bool[Tensor, "M N"],
    principal_point: Float[Tensor, "2"],
    size: tuple[int, int],
    weights: Float[Tensor, " M"] | None = None,
    threshold: float = 1.0,
    k1_std: float = 0.03,
) -> ViewGraphFocal:
    """Find the focal length of a camera from the matches of pairs of its images, pixels.

    Refines the fundamental matrices on the matches, and uses how uncertain each is and how distortion would change
    it. Pairs whose matches a homography explains, those of a plane or of a camera that only turned, are left out. The
    same motions as for `focal_from_fundamentals` have no information.

    Args:
        F_21: in pixels, x_2^T F_21 x_1 = 0, such as from RANSAC: where the refinement starts.
        mask: inliers of F_21; a pair with fewer than 20 is left out.
        principal_point: pixels.
        size: width and height of the images, pixels; sets the range of the search.
        weights: as of `focal_from_fundamentals`.
        threshold: pixels, about the noise of one coordinate or somewhat more.
        k1_std: standard deviation of the camera's k1 around zero: it is estimated too, as its error would be one of
            the focal length. 0.03 (0.01 to 1 were tried) is that of a camera called undistorted; zero for none.

    Returns:
        The focal length, with the gradient to the matches and weights of the minima, the noise fixed.
    """
    mask = mask & torch.isfinite(pixels_1).all(-1) & torch.isfinite(pixels_2).all(-1)
    x_1, x_2 = (
        (torch.where(mask[..., None], x.double(), 0.0) - principal_point.double()) / max(size)
        for x in (pixels_1, pixels_2)
    )
    weights = F_21.new_ones(len(F_21)) if weights is None else weights
    weights = torch.where(mask.sum(-1) >= _MIN_MATCHES, weights, 0.0)
    start, weights = _scaled(F_21.detach(), principal_point, size, weights)
    used = weights > 0
    refined = refine_fundamental(start, x_1, x_2, mask & used[:, None], threshold / max(size))
    if bool(used.any()):
        used = used & (homography_share(x_1, x_2, mask, refined.noise) < _MAX_HOMOGRAPHY_SHARE)
    weights = torch.where(used, weights, 0.0)
    graph = _Graph(refined.F_21, refined.covariance, refined.bend, weights)
    return _solve(graph, k1_std, size, F_21.dtype)


def _scaled(
    F_21: Float[Tensor, "M 3 3"],
    principal_point: Float[Tensor, "2"],
    size: tuple[int, int],
    weights: Float[Tensor, " M"] | None,
) -> tuple[Float[Tensor, "M 3 3"], Float[Tensor, " M"]]:
    """Matrices for pixels from the principal point in longer sides, and weights, zero of a matrix that is none.

    That of a shift to the side takes its place, so that nothing is NaN.
    """
    side = principal_point.new_tensor((max(size), max(size), 1.0), dtype=torch.float64).diag()
    to_pixels = torch.cat((side[:, :2], homogeneous(principal_point.double())[:, None]), 1)
    F = to_pixels.mT @ F_21.double() @ to_pixels
    weights = torch.ones_like(F[:, 0, 0]) if weights is None else weights.double()
    used = (weights > 0) & torch.isfinite(F).all(-1).all(-1) & (F != 0).any(-1).any(-1)
    shift = F.new_tensor(((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)))
    return torch.where(used[:, None, None], F, shift), torch.where(used, weights, 0.0)


class _Graph(NamedTuple):
    """Pairs in scaled coordinates, as of `RefinedFundamental`, and their weights.

    In float64 whatever the input: what counts is a small difference of the singular values.
    """

    F: Float[Tensor, "M 3 3"]
    covariance: Float[Tensor, "M 9 9"]
    bend: Float[Tensor, "M 9"]
    weights: Float[Tensor, " M"]


class _Squares(NamedTuple):
    """Squared whitened errors of pairs, as polynomials of k1: constant + 2 linear k1 + square k1^2."""

    constant: Float[Tensor, "G M"]
    linear: Float[Tensor, "G M"]
    square: Float[Tensor, "G M"]

    def at(self, k1: Float[Tensor, " G"]) -> Float[Tensor, "G M"]:
        k1 = k1[:, None]
        return (self.constant + k1 * (2 * self.linear + k1 * self.square)).clamp_min(0.0)


def _squares(graph: _Graph, focal: Float[Tensor, " G"]) -> _Squares:
    """The errors of the pairs with each of the focal lengths (longer sides), differentiable."""
    F, one = graph.F, torch.ones_like(focal)
    K = torch.stack((focal, focal, one), dim=-1)[:, None]
    null = (_null_vector(F) / K, _null_vector(F.mT) / K)  # of K F K, from the right and from the left
    B_1, B_2 = (tangent_basis(e / e.norm(dim=-1, keepdim=True)) * K[:, :, None] for e in null)
    a, b, c, d = (B_2 @ F @ B_1.mT).detach().flatten(-2).unbind(-1)
    # Of a reflection, one axis is turned around: then it is a rotation.
    sign = torch.where(a * d < b * c, -1.0, 1.0).to(a.dtype)
    b_1, b_2 = B_1[..., 0, :], B_1[..., 1, :] * sign[..., None]
    c_1, c_2 = B_2[..., 0, :], B_2[..., 1, :]

    def outer(c: Tensor, b: Tensor) -> Tensor:
        return (c[..., :, None] * b[..., None, :]).flatten(-2)

    rows = torch.stack((outer(c_1, b_1) - outer(c_2, b_2), outer(c_1, b_2) + outer(c_2, b_1)), dim=-2)
    eye = torch.eye(9, dtype=F.dtype, device=F.device)
    W = rows @ (graph.covariance + _MODEL_NOISE**2 * eye) @ rows.mT
    error = (rows @ F.flatten(-2)[..., None]).squeeze(-1)
    # A point seen at x lies, without distortion, at x (1 - k1 |x|^2 / focal^2).
    change = (rows @ graph.bend[..., None]).squeeze(-1) / -focal.square()[:, None, None]
    w_11, w_12, w_22 = W[..., 0, 0], W[..., 0, 1], W[..., 1, 1]
    determinant = w_11 * w_22 - w_12 * w_12

    def product(a: Tensor, b: Tensor) -> Tensor:
        cross = a[..., 0] * b[..., 1] + a[..., 1] * b[..., 0]
        return (w_22 * a[..., 0] * b[..., 0] - w_12 * cross + w_11 * a[..., 1] * b[..., 1]) / determinant

    return _Squares(product(error, error), product(error, change), product(change, change))


def _null_vector(F: Float[Tensor, "M 3 3"]) -> Float[Tensor, "M 3"]:
    """v with F v = 0: the largest cross product of two rows."""
    normals = torch.linalg.cross(F, F.roll(1, dims=-2), dim=-1)
    largest = normals.detach().square().sum(-1).argmax(-1)
    return normals.gather(1, largest[:, None, None].expand(-1, 1, 3)).squeeze(1)


def _costs(squares: Float[Tensor, "G M"], weights: Float[Tensor, " M"], level: float) -> Float[Tensor, "G M"]:
    """Robust costs of the pairs; one with an error as the noise explains costs about two."""
    return weights * robustify(squares / level, "cauchy", squares.new_tensor(_KERNEL_SCALE)).rho


class _Profile(NamedTuple):
    """The search on the grid: costs of the pairs, k1 of each focal length, the best of them, and the noise level.

    The level is by how much the squared errors exceed what the noise of the matches explains.
    """

    log_focal: Float[Tensor, " G"]
    costs: Float[Tensor, "G M"]
    k1: Float[Tensor, " G"]
    prior: Float[Tensor, " G"]
    best: int
    level: float


def _search(graph: _Graph, k1_std: float) -> _Profile:
    low, high = (math.log(end) for end in RANGE)
    log_focal = torch.linspace(low, high, _GRID, dtype=graph.F.dtype, device=graph.F.device)
    squares, level = _squares(graph, log_focal.exp()), 1.0
    scale = log_focal.new_tensor(_KERNEL_SCALE)
    for _ in range(4):  # level and best of the grid hardly change after the second
        k1 = torch.zeros_like(log_focal)
        for _ in range(10):  # of reweighting, for the grid only: Newton's method does the rest
            weight = graph.weights / level * robustify(squares.at(k1) / level, "cauchy", scale).weight
            k1 = -(weight * squares.linear).sum(-1) / ((weight * squares.square).sum(-1) + k1_std**-2)
        at = squares.at(k1)
        costs, prior = _costs(at, graph.weights, level), (k1 / k1_std).square()
        best = int((costs.sum(-1) + prior).argmin())
        before, level = level, max(1.0, weighted_median(at[best], graph.weights) / NORMAL_SQUARED_MEDIAN_2D)
        if level == before:
            break
    return _Profile(log_focal, costs, k1, prior, best, before)


def _solve(graph: _Graph, k1_std: float, size: tuple[int, int], dtype: torch.dtype) -> ViewGraphFocal:
    """The minimum of the cost, how certain it is, and its gradient."""
    if k1_std == 0:  # without an effect on the errors, k1 stays zero
        graph, k1_std = graph._replace(bend=torch.zeros_like(graph.bend)), 1.0
    with torch.no_grad():
        fixed = _Graph(*(x.detach() for x in graph))
        profile = _search(fixed, k1_std)
        found, H = _polished(fixed, profile, k1_std)
        std = _standard_error(fixed, profile, found[0], H)
        errors = (_squares(fixed, found[:1].exp()).at(found[1:])[0] / profile.level).sqrt()
        # All focal lengths not clearly worse are close, and inside of the range.
        cost = profile.costs.sum(-1) + profile.prior
        possible = cost < cost[profile.best] + _RISE
        far = (profile.log_focal - found[0]).abs() > 3 * _MAX_STD
        success = bool(std < _MAX_STD) and not bool((possible & far).any() | possible[0] | possible[-1])
    at = found
    if success and needs_gradient(*graph):

        def objective(step: Float[Tensor, "1 2"]) -> Float[Tensor, "1"]:
            return _cost(graph, found + step[0], profile.level, k1_std)[None]

        at = found + implicit_step(objective, found[None])[0]  # a step of zero that has the gradient
    used = graph.weights > 0
    return ViewGraphFocal(
        (max(size) * at[0].exp()).to(dtype),
        std.to(dtype),
        torch.where(used, errors, torch.nan).to(dtype),
        used & (errors < 3.03),  # 99 % of the lengths of such a vector are shorter
        torch.tensor(success, device=used.device),
        at[1].to(dtype),
    )


def _cost(graph: _Graph, at: Float[Tensor, "2"], level: float, k1_std: float) -> Float[Tensor, ""]:
    """The cost with the logarithm of the focal length and k1."""
    squares = _squares(graph, at[:1].exp()).at(at[1:])
    return _costs(squares, graph.weights, level).sum() + (at[1] / k1_std).square()


def _polished(
    graph: _Graph, profile: _Profile, k1_std: float
) -> tuple[Float[Tensor, "2"], Float[Tensor, "2 2"]]:
    """The minimum within two steps of the best of the grid, by Newton's method, and the Hessian there."""

    def derivatives(at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        with torch.enable_grad():
            at = at.detach().requires_grad_()
            cost = _cost(graph, at, profile.level, k1_std)
            (gradient,) = torch.autograd.grad(cost, at, create_graph=True)
            rows = [torch.autograd.grad(entry, at, retain_graph=True)[0] for entry in gradient]
        return cost.detach(), gradient.detach(), torch.stack(rows)

    log_focal, best = profile.log_focal, profile.best
    start = torch.stack((log_focal[best], profile.k1[best]))
    at, width = start, float(log_focal[1] - log_focal[0])
    cost, gradient, H = derivatives(at)
    for _ in range(20):  # about five are needed
        factor, info = torch.linalg.cholesky_ex(H)
        if int(info) != 0:
            break
        step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
        for _ in range(20):
            if abs(float(at[0] + step[0] - start[0])) <= 2 * width:
                found = derivatives(at + step)
                if float(found[0]) <= float(cost) + _ROUNDING * (1 + float(cost)):
                    break
            step = 0.5 * step
        else:
            break
        at, (cost, gradient, H) = at + step, found
        if float(step.abs().max()) < _ROUNDING:
            break
    return at, H


def _standard_error(
    graph: _Graph, profile: _Profile, log_focal: Float[Tensor, ""], H: Float[Tensor, "2 2"]
) -> Float[Tensor, ""]:
    """The larger of the errors by the curvature of the cost and by leaving out one pair at a time (jackknife)."""
    factor, info = torch.linalg.cholesky_ex(0.5 * H)  # the cost is twice a negative log likelihood
    if int(info) != 0 or int((graph.weights > 0).sum()) < 2:  # nothing confirms a single pair
        return H.new_tensor(torch.inf)
    variance = torch.cholesky_inverse(factor)[0, 0]
    costs = profile.costs.sum(-1, keepdim=True) - profile.costs + profile.prior[:, None]
    # Their minima, by a parabola through the lowest value and its neighbors.
    grid = profile.log_focal
    best = costs.argmin(0).clamp(1, len(grid) - 2)
    below, middle, above = (costs.gather(0, (best + i)[None])[0] for i in (-1, 0, 1))
    bend = below - 2 * middle + above
    shift = torch.where(bend > 0, 0.5 * (below - above) / bend.clamp_min(torch.finfo(bend.dtype).tiny), 0.0)
    minima = grid[best] + shift.clamp(-1.0, 1.0) * (grid[1] - grid[0])
    shifts = (minima - log_focal)[graph.weights > 0]
    jackknife = shifts.square().sum() * (len(shifts) - 1) / len(shifts)
    return torch.maximum(variance, jackknife).sqrt()
