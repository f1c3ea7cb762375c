"""The pose of a camera from three rays and three points."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


def p3p(rays: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """All poses R, t with ray_i parallel to R point_i + t, of three rays and points: up to four.

    rays: (..., 3, 3), the rows of unit length; points: (..., 3, 3), one per row. Returns R (..., 4, 3, 3),
    t (..., 4, 3) and valid (..., 4); invalid entries and degenerate samples (collinear points) may hold anything.
    Not differentiable by design: it makes hypotheses.

    The three distance equations in the depths form a pencil of conics; a degenerate one of them is a pair of lines,
    which a real root of a cubic finds, and lines meet a conic in closed form.
    Source: Persson and Nordberg, "Lambda twist", 2018; Ding et al., "Revisiting the P3P problem", 2023.
    """
    with torch.no_grad():
        # Inside, the samples are the last dimension: (sample row, coordinate, S).
        f, X = (x.reshape(-1, 3, 3).permute(1, 2, 0).contiguous() for x in (rays, points))
        depths, valid = _depths(f, X)
        corners = depths[:, None] * f[:, :, None]
        frame_c, frame_w = _frame(corners), _frame(X)
        R = torch.matmul(frame_c.permute(3, 2, 1, 0), frame_w.permute(2, 0, 1)[:, None])
        t = (corners.sum(0).permute(2, 1, 0) - (R @ X.sum(0).T[:, None, :, None]).squeeze(-1)) / 3
        valid = valid.T & torch.isfinite(t.sum(-1))
        shape = rays.shape[:-2]
    return R.unflatten(0, shape), t.unflatten(0, shape), valid.unflatten(0, shape)


def _frame(corners: Tensor) -> Tensor:
    """The orthonormal frames of triangles, one axis after the other. (3, 3, ...) -> (axis, coordinate, ...)."""
    a, b = corners[1] - corners[0], corners[2] - corners[0]
    z = _cross(a, b)
    x, z = a * a.square().sum(0).rsqrt(), z * z.square().sum(0).rsqrt()
    return torch.stack((x, _cross(z, x), z))


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """(3, ...) twice -> (3, ...)."""
    return a.roll(-1, 0) * b.roll(-2, 0) - a.roll(-2, 0) * b.roll(-1, 0)


# Of a symmetric matrix the entries 00, 01, 02, 11, 12, 22 are stored; where each entry of the full one lies.
_FULL = (0, 1, 2, 1, 3, 4, 2, 4, 5)
# The adjugate's entries are differences of products of two of them.
_ADJUGATE_PLUS, _ADJUGATE_MINUS = (
    ((3, 5), (2, 4), (1, 4), (0, 5), (1, 2), (0, 3)),
    ((4, 4), (1, 5), (2, 3), (2, 2), (0, 4), (1, 1)),
)


@lru_cache(maxsize=4)
def _tables(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of the factors of the adjugate, (4, 6); of the full matrix, (9,); of the next two axes, (2, 3)."""
    factors = torch.tensor(
        (*zip(*_ADJUGATE_PLUS, strict=True), *zip(*_ADJUGATE_MINUS, strict=True)), device=device
    )
    return factors, torch.tensor(_FULL, device=device), torch.tensor(((1, 2, 0), (2, 0, 1)), device=device)


def _depths(rays: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Depths (3, 4, S) along the rays (3, 3, S) to the points (3, 3, S), and which are real and positive (4, S)."""
    # of the pairs 12, 23, 31
    distance = (points - points.roll(-1, 0)).square_().sum(1)
    cosine = (rays * rays.roll(-1, 0)).sum(1)
    unit = distance.sum(0)
    distance = distance / unit
    a12, a23, a13 = distance.unbind(0)
    b12, b23, b13 = cosine.unbind(0)
    zero = torch.zeros_like(a12)

    # depths^T D depths = 0 for both
    D_1 = torch.stack((a23, -a23 * b12, zero, a23 - a12, a12 * b23, -a12))
    D_2 = torch.stack((a23, zero, -a23 * b13, -a13, a13 * b23, a23 - a13))
    lines, conic, real = _line_pair(torch.stack((D_1, D_2), dim=1))
    depths, on_conic = _intersections(lines, conic)

    # Their scale follows from the sum of the three equations.
    products = depths * depths.roll(-1, 0) * cosine[:, None]
    size = 2 * (depths * depths - products).sum(0)
    depths = depths * torch.copysign(size.rsqrt(), depths.sum(0))
    depths = _polish(depths, cosine[:, None], distance[:, None])
    return depths * unit.sqrt(), real & on_conic & (depths > 0).all(0)


def _adjugate(M: Tensor, factors: Tensor) -> Tensor:
    """Adjugate of symmetric matrices. (6, ...) -> (6, ...)."""
    a, b, c, d = (M.index_select(0, index) for index in factors)
    return torch.addcmul(a * b, c, d, value=-1)


def _line_pair(D: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The two lines of a degenerate conic in the pencil of two. (6, 2, S) -> (3, 2, S), (9, S), (S,).

    Also returns the regular one of the two conics, to intersect with, and whether the lines are real.
    """
    factors, full, _ = _tables(D.device)
    adjugate = _adjugate(D, factors)
    # tr(adj(D_i) D_j), whose diagonal is 3 det(D_i)
    traces = (adjugate[:, :, None] * D[:, None])[full].sum(0)
    # det(low + g high): make the leading coefficient, det(high), the larger one
    swap = traces[0, 0].abs() > traces[1, 1].abs()
    low, high = torch.where(swap, D.flip(1), D).unbind(1)
    (t_00, t_01), (t_10, t_11) = torch.where(swap, traces.flip(0, 1), traces)
    leading = 3 / t_11
    g = _cubic_root(t_10 * leading, t_01 * leading, t_00 / t_11)
    degenerate = torch.addcmul(low, g, high)

    # Richter-Gebert, "Perspectives on projective geometry", 2011: adj = -p p^T with p where the lines meet, and
    # degenerate + [p]x has rank one, with the lines as its row and its column.
    adjugate = _adjugate(degenerate, factors)[full].unflatten(0, (3, 3))
    diagonal = adjugate.diagonal().mT
    largest = diagonal.abs().argmax(0, keepdim=True)
    pivot = diagonal.gather(0, largest)
    x, y, z = adjugate.gather(0, largest[:, None].expand(1, 3, -1))[0] * (-pivot).clamp_min(1e-300).rsqrt()
    zero = torch.zeros_like(x)
    pair = degenerate[full] + torch.stack((zero, -z, y, z, zero, -x, -y, x, zero))
    pair = pair.unflatten(0, (3, 3))
    size = pair.abs()
    i, j = size.amax(1).argmax(0), size.amax(0).argmax(0)
    row, column = pair.gather(0, i.expand(1, 3, -1))[0], pair.gather(1, j.expand(3, 1, -1))[:, 0]
    return torch.stack((column, row), dim=1), high[full], pivot[0] <= 0


def _intersections(lines: Tensor, conic: Tensor) -> tuple[Tensor, Tensor]:
    """Where two lines meet a conic, up to scale. (3, 2, S), (9, S) -> (3, 4, S), real (4, S).

    Along each line two depths, a and b, are free; the one with the largest coefficient, c, follows.
    """
    _, _, following = _tables(lines.device)
    c = lines.abs().argmax(0)
    axes = torch.stack((c, *following[:, c]))
    l_c, l_a, l_b = lines.gather(0, axes)
    l_a, l_b = l_a / l_c, l_b / l_c
    pairs = 3 * axes[[0, 0, 0, 1, 1, 2]] + axes[[0, 1, 2, 1, 2, 2]]
    cc, ca, cb, aa, ab, bb = conic[:, None].expand(9, 2, -1).gather(0, pairs)
    A = aa + l_a * (l_a * cc - 2 * ca)
    B = ab + l_a * (l_b * cc - cb) - l_b * ca
    C = bb + l_b * (l_b * cc - 2 * cb)
    discriminant = B * B - A * C
    root = -(B + torch.copysign(discriminant.clamp_min(0.0).sqrt(), B))
    a, b = torch.stack((root, C)), torch.stack((A, root))
    depths = torch.stack((-(l_a * a + l_b * b), a, b))
    depths = torch.zeros_like(depths).scatter(0, axes[:, None].expand_as(depths), depths)
    return depths.flatten(1, 2), (discriminant >= 0).repeat(2, 1)


def _cubic_root(b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """The real root of x^3 + b x^2 + c x + d that lies farthest from the others."""
    shift = b / 3
    p = c - b * shift
    q = shift * (2 * shift * shift - c) + d
    discriminant = 0.25 * q * q + p * p * p / 27
    # one real root: Cardano, without cancellation
    u = 0.5 * q.abs() + discriminant.clamp_min(0.0).sqrt()
    u = u.clamp_min(torch.finfo(b.dtype).tiny) ** (1 / 3)
    single = u - p / (3 * u)
    # three real roots: the outermost one, by the cosine
    radius = (-p / 3).clamp_min(torch.finfo(b.dtype).tiny).sqrt()
    angle = torch.acos((0.5 * q.abs() / (radius * radius * radius)).clamp_max(1.0))
    triple = 2 * radius * torch.cos(angle / 3)
    x = torch.copysign(torch.where(discriminant > 0, single, triple), -q) - shift
    for _ in range(2):
        slope = (3 * x + 2 * b) * x + c
        x = x - (((x + b) * x + c) * x + d) / torch.where(slope == 0, 1.0, slope)
    return x


def _polish(depths: Tensor, cosine: Tensor, distance: Tensor) -> Tensor:
    """A Newton step on the three distance equations. (3, 4, S), (3, 1, S), (3, 1, S) -> (3, 4, S)."""
    following = depths.roll(-1, 0)
    # J = 2 [[a1 b1 0], [0 a2 b2], [b3 0 a3]], solved by Cramer's rule
    a, b = (
        torch.addcmul(depths, cosine, following, value=-1),
        torch.addcmul(following, cosine, depths, value=-1),
    )
    residual = depths * a + following * b - distance
    a_2 = a.roll(-2, 0)
    determinant = 2 * (a[0] * a[1] * a[2] + b[0] * b[1] * b[2])
    numerator = a_2 * (a.roll(-1, 0) * residual - b * residual.roll(-1, 0))
    numerator = torch.addcmul(numerator, b * b.roll(-1, 0), residual.roll(-2, 0))
    return depths - numerator / torch.where(determinant == 0, 1.0, determinant)
