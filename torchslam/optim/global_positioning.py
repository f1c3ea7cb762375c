"""Global positioning, first version."""
from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.geometry.robust import robustify
from torchslam.optim._core.levenberg_marquardt import minimize_batch
from torchslam.optim.bundle._schur import BundleTangent, NormalEquations
from torchslam.optim.bundle._sparse import build_sparse_layout


class Estimate(NamedTuple):
    centers: Tensor
    points: Tensor
    inverse: Tensor


@dataclass
class Model:
    estimate: Estimate
    cost: Tensor
    r: Tensor
    u: Tensor
    w: Tensor


class GP:
    def __init__(self, frame, point, rays, K, N, weights, kernel, scale):
        dev = rays.device
        free = torch.ones(K, dtype=torch.bool)
        self.layout = build_sparse_layout(frame, point, torch.ones(len(frame), dtype=torch.bool), free,
                                          torch.ones(N, dtype=torch.bool), torch.zeros(K, dtype=torch.int64), 1)
        L = self.layout
        self.rays = rays[L.observations]
        self.weights = weights[L.observations]
        self.kernel, self.scale = kernel, torch.tensor(scale, dtype=rays.dtype)
        self.solvable = torch.tensor([True])

    def evaluate(self, e, use_curvature):
        L = self.layout
        u = e.points[L.point_index] - e.centers[L.frame_index]
        r = self.rays - e.inverse[:, None] * u
        k = robustify(self.weights * r.square().sum(-1), self.kernel, self.scale)
        return Model(e, 0.5 * k.rho.sum()[None], r, u, self.weights * k.weight)

    def step(self, m, damping):
        L, e, lam = self.layout, m.estimate, damping[0]
        d = e.inverse[:, None]
        uu = m.u.square().sum(-1, keepdim=True)
        ur = (m.u * m.r).sum(-1, keepdim=True)
        den = (1 + lam) * uu + 1e-12
        w = m.w[:, None]
        g = -w * (d * m.r - d * m.u * ur / den)  # reduced gradient in u
        eye = torch.eye(3, dtype=g.dtype)
        H = (w * d * d)[..., None] * (eye - m.u[:, :, None] * m.u[:, None] / den[..., None])
        S = L.structure
        points = S.sum_by_point(torch.cat((H, g[..., None]), -1).flatten(1)).unflatten(-1, (3, 4))
        fr = S.sum_by_frame(torch.cat((H, -g[..., None]), -1).movedim(0, -1))
        n = len(fr)
        zero = g.new_zeros
        eq = NormalEquations(S, BundleTangent(fr[..., 3], points[..., 3], zero(1, 0)), fr[..., :3], points[..., :3],
                             zero(1, 0, 0), zero(n, 3, 0), S.coupling.stored(-H), zero(S.camera_coupling.size, 0),
                             L.free_points)
        f = eq.factorized(damping)
        st = f.solve(eq.gradient)
        du = -(st.points[L.point_index] - st.frames[L.frame_index])
        dd = ((m.u * m.r).sum(-1) - e.inverse * (m.u * du).sum(-1)) / den[:, 0]
        new = Estimate(e.centers - st.frames, e.points - st.points, (e.inverse + dd).clamp(min=1e-5))
        pred = 0.5 * st.dot(eq.gradient) + 0.5 * (m.w * (m.u * m.r).sum(-1) ** 2 / den[:, 0]).sum()
        return new, torch.where(f.reduced.definite, pred, torch.inf)[None]

    def select(self, accept, new, old):
        return new if bool(accept) else old


def position(frame, point, rays_w, K, N, weights=None, kernel="huber", scale=0.1, start=None, seed=0, iterations=100, tolerance=1e-5):
    weights = torch.ones(len(frame), dtype=rays_w.dtype) if weights is None else weights
    p = GP(frame, point, rays_w, K, N, weights, kernel, scale)
    L = p.layout
    g = torch.Generator().manual_seed(seed)
    if start is None:
        c = torch.rand(K, 3, generator=g, dtype=rays_w.dtype) * 2 - 1
        X = torch.rand(N, 3, generator=g, dtype=rays_w.dtype) * 2 - 1
    else:
        c, X = start
    u = X[L.point_order][L.point_index] - c[L.frame_index]
    d = torch.ones(len(L.frame_index), dtype=c.dtype) if start is None else ((u * p.rays).sum(-1) / u.square().sum(-1).clamp(min=1e-12)).clamp(min=1e-5)
    m, conv = minimize_batch(p, Estimate(c, X[L.point_order], d), iterations, tolerance)
    ang = torch.nn.functional.cosine_similarity(m.u, p.rays, dim=-1)
    angles = torch.empty_like(ang); angles[L.observations] = torch.arccos(ang.clamp(-1, 1))
    return m.estimate.centers, m.estimate.points[L.point_rank], angles, conv


class _Positions(NamedTuple):
    """Until the finished function replaces this file."""

    centers_w: Tensor
    points_w: Tensor
    angles: Tensor
    convergence: object


def position_globally(view_index: Tensor, point_index: Tensor, rays_w: Tensor, num_views: int, num_points: int, **options: object) -> _Positions:
    return _Positions(*position(view_index, point_index, rays_w, num_views, num_points, **options))  # type: ignore[arg-type]
