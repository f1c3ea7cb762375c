"""Matches of pairs of views, as the fits of all three models see them.

Residuals are in units of the threshold: to first order, the distance by which the match would have to move in both
images together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.ransac import gather_rows

# Thresholds: a two-dimensional error so large is as probable as a one-dimensional one of one.
TRANSFER_WIDTH = 1.5


@dataclass(frozen=True)
class TwoViews:
    """Matches of B pairs of views.

    x_1, x_2: (B, N, 2) undistorted image coordinates
    scale_1, scale_2: (B, N) thresholds per unit of them
    mask:     (B, N)
    """

    x_1: Tensor
    x_2: Tensor
    scale_1: Tensor
    scale_2: Tensor
    mask: Tensor

    @staticmethod
    def of(
        pixels_1: Tensor,
        pixels_2: Tensor,
        camera_1: Camera,
        camera_2: Camera,
        threshold: float,
        mask: Tensor,
        weights: Tensor | None,
    ) -> TwoViews:
        x_1, x_2 = camera_1.normalize(pixels_1), camera_2.normalize(pixels_2)
        scale_1, scale_2 = (
            camera.pixel_scale(x).prod(-1).sqrt() / threshold
            for camera, x in ((camera_1, x_1), (camera_2, x_2))
        )
        views = TwoViews(x_1, x_2, scale_1, scale_2, mask)
        return views if weights is None else views.in_units(torch.where(mask, weights, 1.0).rsqrt())

    def in_units(self, thresholds: Tensor) -> TwoViews:
        """The same with thresholds so many times as large. (B, N) or (B, 1)."""
        return replace(self, scale_1=self.scale_1 / thresholds, scale_2=self.scale_2 / thresholds)

    def select(self, rows: Tensor) -> TwoViews:
        """Some of the problems."""
        if len(rows) == len(self.mask):
            return self
        return TwoViews(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def rows(self, rows: Tensor) -> TwoViews:
        """Some of the matches of each problem. (B, n) row numbers."""
        x_1, x_2 = gather_rows(self.x_1, rows), gather_rows(self.x_2, rows)
        return TwoViews(x_1, x_2, *(x.gather(1, rows) for x in (self.scale_1, self.scale_2, self.mask)))

    @cached_property
    def h_1(self) -> Tensor:
        """(B, N, 3) homogeneous x_1."""
        return torch.cat((self.x_1, torch.ones_like(self.x_1[..., :1])), dim=-1)

    @cached_property
    def h_2(self) -> Tensor:
        """(B, N, 3) homogeneous x_2."""
        return torch.cat((self.x_2, torch.ones_like(self.x_2[..., :1])), dim=-1)

    @cached_property
    def epipolar(self) -> tuple[Tensor, Tensor]:
        """What the Sampson error is linear in: (B, 9, N) for the constraint, (B, 18, N) for its variance.

        The constraint is E times h_2 h_1^T; its variance (E E^T and E^T E without the last row and column) times
        h_1 h_1^T and h_2 h_2^T, over the squared scale of the other image.
        """
        h_1, h_2 = self.h_1.mT, self.h_2.mT
        outer_1 = h_1[:, :, None] * (h_1 * self.scale_2.square().reciprocal()[:, None])[:, None]
        outer_2 = h_2[:, :, None] * (h_2 * self.scale_1.square().reciprocal()[:, None])[:, None]
        constraint = (h_2[:, :, None] * h_1[:, None]).flatten(1, 2)
        return constraint, torch.cat((outer_1, outer_2), dim=1).flatten(1, 2)

    @cached_property
    def epipolar_float(self) -> tuple[Tensor, Tensor]:
        """The same in float32, for scores."""
        constraint, variance = self.epipolar
        return constraint.float(), variance.float()

    @cached_property
    def transfer_scale(self) -> Tensor:
        """(B, N) thresholds per unit of a difference H(x_1) - x_2, which has the noise of both images.

        Two-dimensional errors get a threshold of their own, see `TRANSFER_WIDTH`.
        """
        return (
            self.scale_1.square().reciprocal() + self.scale_2.square().reciprocal()
        ).rsqrt() / TRANSFER_WIDTH
