"""The pose of a camera from three rays and three points."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.precision import full_precision


@full_precision
def p3p(
    rays: Float[Tensor, "*batch 3 3"], points: Float[Tensor, "*batch 3 3"]
) -> tuple[Float[Tensor, "*batch 4 3 3"], Float[Tensor, "*batch 4 3"], Bool[Tensor, "*batch 4"]]:
    """Compute all poses R, t with ray_i parallel to R point_i + t for three rays and points.

    Not differentiable by design: it generates hypotheses. The three distance equations in the depths form a pencil
    of conics; a degenerate one of them is a pair of lines, which a real root of a cubic finds, and lines meet a
    conic in closed form. Source: Persson and Nordberg, "Lambda twist", 2018; Ding et al., "Revisiting the P3P
    problem", 2023.

    Args:
        rays: rows of unit length.
        points: one point per row.

    Returns:
        R, t and valid for up to four solutions. Invalid entries, and all entries of degenerate samples (collinear
        points), may hold anything.
    """
    with torch.no_grad():
        # Inside, the samples are the last dimension: (sample row, coordinate, S).
        f, X = (x.reshape(-1, 3, 3).permute(1, 2, 0).contiguous() for x in (rays, points))
        depths, valid = _depths(f, X)
        corners = depths[:, None] * f[:, :, None]
        frames = _frame(torch.cat((corners, X[:, :, None]), dim=2))
        R = (frames[:, :, None, :4] * frames[:, None, :, 4:]).sum(0)
        t = (corners.sum(0) - (R * X.sum(0)[:, None]).sum(1)) / 3
        R, t, valid = R.permute(3, 2, 0, 1), t.permute(2, 1, 0), (valid & torch.isfinite(t.sum(0))).T
        shape = rays.shape[:-2]
    return R.unflatten(0, shape), t.unflatten(0, shape), valid.unflatten(0, shape)


def _frame(corners: Tensor) -> Tensor:
    """The orthonormal frames of triangles, one axis after the other. (3, 3, ...) -> (axis, coordinate, ...)."""
    a, b = (corners[1:] - corners[:1]).unbind(0)
    axes = torch.stack((a, torch.linalg.cross(a, b, dim=0)))
    x, z = axes.mul_(axes.square().sum(1, keepdim=True).rsqrt_()).unbind(0)
    return torch.stack((x, torch.linalg.cross(z, x, dim=0), z))


@lru_cache(maxsize=4)
def _tables(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The factors of the entries of an adjugate, and how often each entry is in the full matrix (6, 1).

    Of a symmetric matrix the entries 00, 01, 02, 11, 22, 12 are stored. Those of its adjugate are a b - c d: all a,
    then all b, c and d.
    """
    adjugate = (3, 2, 1, 0, 0, 1, 4, 5, 5, 4, 3, 2, 5, 1, 2, 2, 1, 0, 5, 4, 3, 2, 1, 5)
    times = torch.tensor((1, 2, 2, 1, 1, 2), dtype=dtype, device=device)
    return torch.tensor(adjugate, device=device), times[:, None]


def _depths(
    rays: Float[Tensor, "3 3 B"], points: Float[Tensor, "3 3 B"]
) -> tuple[Float[Tensor, "3 4 B"], Bool[Tensor, "4 B"]]:
    """Depths along the rays to the points, and which are real and positive."""
    # of the pairs 12, 23, 31
    distance = (points - points.roll(-1, 0)).square_().sum(1)
    cosine = (rays * rays.roll(-1, 0)).sum(1)
    unit = distance.sum(0)
    distance = distance / unit
    # The two conics of the pencil, depths^T D depths = 0.
    (d_1, d_2, d_3), zero = distance.unbind(0), torch.zeros_like(unit)
    mixed_1, mixed_2 = d_1 * cosine[1], d_2 * cosine[::2]
    first = torch.stack((d_2, -mixed_2[0], zero, d_2 - d_1, -d_1, mixed_1))
    D = torch.stack((first, torch.stack((d_2, zero, -mixed_2[1], -d_3, d_2 - d_3, d_3 * cosine[1]))))
    lines, real = _line_pair(D)
    depths, on_conic = _intersections(lines, D[1])

    # Their scale follows from the sum of the three equations.
    products = depths * depths.roll(-1, 0) * cosine[:, None]
    size = 2 * (depths * depths - products).sum(0)
    depths = depths * torch.copysign(size.rsqrt_(), depths[2])
    depths = _polish(depths, cosine[:, None], distance[:, None])
    return depths * unit.sqrt(), (depths > 0).all(0) & real & on_conic


def _line_pair(D: Float[Tensor, "2 6 B"]) -> tuple[Float[Tensor, "2 2 B"], Bool[Tensor, " B"]]:
    """The two lines of a degenerate conic in the pencil of two.

    Each line as p, q of depth_1 = p depth_2 + q depth_3, in the first dimension. Also, whether the lines are real.
    """
    factors, times = _tables(D.dtype, D.device)
    a, b, c, d = D.index_select(1, factors).unflatten(1, (4, 6)).unbind(1)
    adjugate = torch.addcmul(a * b, c, d, value=-1) * times
    # tr(adj(D_i) D_j), whose diagonal is 3 det(D_i), gives det(D_0 + g D_1)
    traces = (adjugate[:, None] * D).sum(2)
    zeroth, first, second = (traces / traces[1, 1]).flatten(0, 1)[:3].unbind(0)
    g = _cubic_root(3 * second, 3 * first, zeroth)
    conic = torch.addcmul(D[0], g, D[1])
    # The equation is quadratic in depth_1; its discriminant, a form in the other depths, is a square.
    squares = torch.addcmul(conic[1:3].square(), conic[:1], conic[3:5], value=-1)
    root = squares.clamp_min(0.0).sqrt_()
    mixed = torch.addcmul(conic[1] * conic[2], conic[0], conic[5], value=-1)
    root = torch.stack((root[0], torch.copysign(root[1], mixed)))
    lines = (torch.stack((root, -root), dim=1) - conic[1:3, None]) / conic[0]
    return lines, (squares >= 0).all(0)


def _intersections(
    lines: Float[Tensor, "2 2 B"], conic: Float[Tensor, "6 B"]
) -> tuple[Float[Tensor, "3 4 B"], Bool[Tensor, "4 B"]]:
    """Intersections of two lines with a conic without entry 01, and which are real."""
    p, q = lines
    xx, _, xz, yy, zz, yz = conic
    part = torch.addcmul(xz, xx, q)
    A = torch.addcmul(yy, xx * p, p)
    B = torch.addcmul(yz, part, p)
    C = torch.addcmul(zz, part + xz, q)
    discriminant = torch.addcmul(B * B, A, C, value=-1)
    root = B.add(torch.copysign(discriminant.clamp_min(0.0).sqrt_(), B)).neg_()
    y, z = torch.stack((root, C)), torch.stack((A, root))
    depths = torch.stack((torch.addcmul(p * y, q, z), y, z))
    return depths.flatten(1, 2), (discriminant >= 0).repeat(2, 1)


def _cubic_root(b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """The real root of x^3 + b x^2 + c x + d that lies farthest from the others."""
    shift = b / 3
    p = torch.addcmul(c, b, shift, value=-1) / 3
    half = torch.addcmul(d, shift, torch.addcmul(c, shift, shift, value=-2), value=-1) / 2
    discriminant = torch.addcmul(half * half, p * p, p)
    # Cardano without cancellation; with three real roots the sum is complex, and its cube root's real part counts
    u = half.abs() + torch.complex(discriminant, torch.zeros_like(p)).sqrt_()
    u = u.pow(1 / 3)
    x = (u - p / u).real.copysign(-half) - shift
    slope = torch.addcmul(c, torch.add(2 * b, x, alpha=3), x)
    return x - torch.addcmul(d, torch.addcmul(c, x + b, x), x) / slope


def _polish(
    depths: Float[Tensor, "3 4 B"], cosine: Float[Tensor, "3 1 B"], distance: Float[Tensor, "3 1 B"]
) -> Float[Tensor, "3 4 B"]:
    """A Newton step on the three distance equations."""
    following = depths.roll(-1, 0)
    # J = 2 [[a1 b1 0], [0 a2 b2], [b3 0 a3]], solved by Cramer's rule
    a, b = (
        torch.addcmul(depths, cosine, following, value=-1),
        torch.addcmul(following, cosine, depths, value=-1),
    )
    residual = depths * a + following * b - distance
    determinant = 2 * (a.prod(0) + b.prod(0))
    numerator = a.roll(-2, 0) * (a.roll(-1, 0) * residual - b * residual.roll(-1, 0))
    numerator = torch.addcmul(numerator, b * b.roll(-1, 0), residual.roll(-2, 0))
    return depths - numerator / determinant
