"""The pose of a camera from three rays and three points."""

from __future__ import annotations

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
        depths, valid = _depths(rays, points)
        points_c = depths[..., None] * rays[..., None, :, :]
        frame_c, frame_w = _frame(points_c), _frame(points)
        R = frame_c @ frame_w[..., None, :, :].mT
        t = points_c.mean(-2) - (R @ points.mean(-2)[..., None, :, None]).squeeze(-1)
        valid = valid & torch.isfinite(t).all(-1) & torch.isfinite(R).all((-2, -1))
    return R, t, valid


def _frame(corners: Tensor) -> Tensor:
    """The orthonormal frame of a triangle, as columns. (..., 3, 3) -> (..., 3, 3)."""
    a, b = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    normal = torch.linalg.cross(a, b, dim=-1)
    x, z = a / a.norm(dim=-1, keepdim=True), normal / normal.norm(dim=-1, keepdim=True)
    return torch.stack((x, torch.linalg.cross(z, x, dim=-1), z), dim=-1)


def _depths(rays: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Depths along the rays, (..., 4, 3), and which are real and positive, (..., 4)."""
    # of the pairs 12, 23, 31
    difference = points - points.roll(-1, -2)
    distance = (difference * difference).sum(-1)
    unit = distance.sum(-1, keepdim=True)
    distance = distance / unit
    a12, a23, a13 = distance.unbind(-1)
    cosine = (rays * rays.roll(-1, -2)).sum(-1)
    b12, b23, b13 = cosine.unbind(-1)
    zero = torch.zeros_like(a12)

    # depths^T D depths = 0 for both
    p, q, r, s = -a23 * b12, a12 * b23, -a23 * b13, a13 * b23
    D_1 = torch.stack((a23, p, zero, p, a23 - a12, q, zero, q, -a12), dim=-1)
    D_2 = torch.stack((a23, zero, r, zero, -a13, s, r, s, a23 - a13), dim=-1)
    D = torch.stack((D_1, D_2), dim=-2).unflatten(-1, (3, 3))
    lines, conic, real = _line_pair(D)

    # Along each line two depths are free, the one with the largest coefficient follows.
    largest = lines.abs().argmax(-1, keepdim=True)
    ratio = lines / lines.gather(-1, largest)
    others = torch.cat(((largest + 1) % 3, (largest + 2) % 3), dim=-1)
    basis = torch.nn.functional.one_hot(others, 3).to(rays.dtype)
    dependent = torch.nn.functional.one_hot(largest, 3).to(rays.dtype)
    basis = basis - ratio.gather(-1, others)[..., None] * dependent
    form = basis @ conic[..., None, :, :] @ basis.mT
    A, B, C = form[..., 0, 0], form[..., 0, 1], form[..., 1, 1]
    discriminant = B * B - A * C
    root = -(B + torch.copysign(discriminant.clamp_min(0.0).sqrt(), B))
    along = torch.stack((torch.stack((root, A), dim=-1), torch.stack((C, root), dim=-1)), dim=-2)
    depths = (along @ basis).flatten(-3, -2)
    real = ((discriminant >= 0) & real[..., None]).repeat_interleave(2, dim=-1)

    # Their scale follows from the sum of the three equations.
    products = depths * depths.roll(-1, -1) * cosine[..., None, :]
    size = 2 * (depths * depths - products).sum(-1, keepdim=True)
    depths = depths * torch.copysign(size.rsqrt(), depths.sum(-1, keepdim=True))
    depths = _polish(depths, cosine[..., None, :], distance[..., None, :])
    return depths * unit[..., None].sqrt(), real & (depths > 0).all(-1)


def _adjugate(M: Tensor) -> Tensor:
    """Adjugate of symmetric matrices. (..., 3, 3) -> (..., 3, 3)."""
    return torch.linalg.cross(M.roll(-1, -2), M.roll(-2, -2), dim=-1)


def _line_pair(D: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The two lines of a degenerate conic in the pencil of two. (..., 2, 3, 3) -> (..., 2, 3), (..., 3, 3), (...).

    Also returns the regular one of the two conics, to intersect with, and whether the lines are real.
    """
    adjugate = _adjugate(D)
    traces = (adjugate[..., :, None, :, :] * D[..., None, :, :, :]).sum((-2, -1))
    determinant = traces.diagonal(dim1=-2, dim2=-1) / 3
    # det(D_low + g D_high): make the leading coefficient, det(D_high), the larger one
    swap = determinant[..., 0].abs() > determinant[..., 1].abs()
    c0 = torch.where(swap, determinant[..., 1], determinant[..., 0])
    c1 = torch.where(swap, traces[..., 1, 0], traces[..., 0, 1])
    c2 = torch.where(swap, traces[..., 0, 1], traces[..., 1, 0])
    c3 = torch.where(swap, determinant[..., 0], determinant[..., 1])
    g = _cubic_root(c2 / c3, c1 / c3, c0 / c3)
    low = torch.where(swap[..., None, None], D[..., 1, :, :], D[..., 0, :, :])
    high = torch.where(swap[..., None, None], D[..., 0, :, :], D[..., 1, :, :])
    degenerate = low + g[..., None, None] * high

    # Richter-Gebert, "Perspectives on projective geometry", 2011: adj = -p p^T with p where the lines meet, and
    # degenerate + [p]x has rank one, with the lines as its row and its column.
    adjugate = _adjugate(degenerate)
    diagonal = adjugate.diagonal(dim1=-2, dim2=-1)
    largest = diagonal.abs().argmax(-1, keepdim=True)
    pivot = diagonal.gather(-1, largest)
    meeting = adjugate.gather(-2, largest[..., None].expand(*largest.shape, 3)).squeeze(-2)
    meeting = meeting * (-pivot).clamp_min(torch.finfo(D.dtype).tiny).rsqrt()
    x, y, z = meeting.unbind(-1)
    zero = torch.zeros_like(x)
    pair = degenerate + torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))
    entry = pair.abs().flatten(-2).argmax(-1)[..., None, None]
    column = pair.gather(-1, (entry % 3).expand(*entry.shape[:-2], 3, 1)).squeeze(-1)
    row = pair.gather(-2, (entry // 3).expand(*entry.shape[:-2], 1, 3)).squeeze(-2)
    return torch.stack((column, row), dim=-2), high, pivot.squeeze(-1) <= 0


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
    """A Newton step on the three distance equations. (..., 4, 3), (..., 1, 3), (..., 1, 3)."""
    following = depths.roll(-1, -1)
    residual = depths * (depths - 2 * cosine * following) + following * following - distance
    # J = 2 [[a1 b1 0], [0 a2 b2], [b3 0 a3]], solved by Cramer's rule
    a, b = depths - cosine * following, following - cosine * depths
    a_2 = a.roll(-2, -1)
    determinant = 2 * (a.prod(-1, keepdim=True) + b.prod(-1, keepdim=True))
    numerator = a_2 * (a.roll(-1, -1) * residual - b * residual.roll(-1, -1))
    numerator = numerator + b * b.roll(-1, -1) * residual.roll(-2, -1)
    return depths - numerator / torch.where(determinant == 0, 1.0, determinant)
