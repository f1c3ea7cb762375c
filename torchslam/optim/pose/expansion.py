"""The local quadratic model of reprojection errors in a pose: what `refine_pose` spends its time on.

Rows of Jacobians run along the observations, (B, D, N), so that one matrix product per problem makes Hessian and
gradient, and every operation before it streams through contiguous memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchslam.optim.core.residuals import Observations, Weighed, linearize, weigh


class PoseModel(NamedTuple):
    """The local model of the cost at poses T_cw (B, 4, 4): cost (B,), gradient (B, 6), hessian (B, 6, 6) in xi.

    hessian: of iteratively reweighted least squares, positive semi-definite, descends from afar
    bend:    (B, 6, 6) what the kernel's curvature adds to it near the optimum, never positive: the steps become
             Newton's, several times as effective; zero elsewhere
    """

    T_cw: Tensor
    cost: Tensor
    gradient: Tensor
    hessian: Tensor
    bend: Tensor


class PoseObservations:
    """Observations (B, N) of known points, laid out for expansions at many poses."""

    def __init__(self, points_w: Tensor, observations: Observations) -> None:
        """points_w: (B, N, 3)"""
        self.observations = observations
        camera = observations.camera
        self.points_w = points_w.mT.contiguous()
        self.pinhole = camera.model == "pinhole" and not observations.has_matrices
        self.metric = camera.params.new_ones(1, 1)  # what turns products of rows into those of pixels
        if self.pinhole:
            focal, centre = camera.params[..., :2, None], camera.params[..., 2:4, None]
            self.normalized = ((observations.pixels.mT - centre) / focal).contiguous()
            self.metric = focal.square()  # (2, 1) or (B, 2, 1)

    def expand(self, T_cw: Tensor, near: Tensor) -> PoseModel:
        """The model at T_cw (B, 4, 4); `near` (B,) says where to add the bend."""
        points_c = torch.baddbmm(T_cw[:, :3, 3:], T_cw[:, :3, :3], self.points_w)
        rows, (cost, weight, bend) = self._pinhole(points_c) if self.pinhole else self._general(points_c)
        moments = (rows * (weight[:, None] * self.metric)[:, None]).flatten(2) @ rows.flatten(2).mT
        hessian, gradient = moments[:, :6, :6], moments[:, :6, 6]
        if near.any():
            pulls = (rows[:, :6] * (self.metric[..., None, :, :] * rows[:, 6:])).sum(2)
            added = (pulls * (bend * near[:, None])[:, None]) @ pulls.mT
        else:
            added = torch.zeros_like(hessian)
        return PoseModel(T_cw, cost.sum(-1), gradient, hessian, added)

    def _pinhole(self, points_c: Tensor) -> tuple[Tensor, Weighed]:
        """Rows (B, 7, 2, N) of d residual / d xi and of the residual, in units of the focal length."""
        depth = points_c[:, 2:]
        valid = depth > torch.finfo(depth.dtype).eps
        inverse = torch.where(valid, depth, 1.0).reciprocal()
        xy = points_c[:, :2] * inverse
        residual = xy - self.normalized
        squared_px = (self.metric * residual.square()).sum(1)

        inverse = inverse[:, 0]
        u, v = xy.unbind(1)
        zero, product = torch.zeros_like(u), u * v
        # d(u, v) / d(translation), then / d(rotation): each line is a column of the Jacobian.
        columns = (
            *(inverse, zero),
            *(zero, inverse),
            *(-inverse * u, -inverse * v),
            *(-product, -1 - v * v),
            *(1 + u * u, product),
            *(-v, u),
            *residual.unbind(1),
        )
        rows = torch.stack(columns, dim=1).unflatten(1, (7, 2))
        return rows, weigh(self.observations, squared_px, valid[:, 0])

    def _general(self, points_c: Tensor) -> tuple[Tensor, Weighed]:
        """As `_pinhole`, for any camera; rows are in pixels."""
        points_c = points_c.mT
        lin = linearize(self.observations, points_c)
        J_rotation = torch.linalg.cross(points_c[..., None, :].expand_as(lin.J), lin.J)
        rows = torch.cat((lin.J, J_rotation, lin.residual[..., None]), dim=-1)
        return rows.permute(0, 3, 2, 1), Weighed(lin.cost, lin.weight, lin.bend)
