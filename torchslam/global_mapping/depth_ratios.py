"""Depths of the matches of an image pair by its relative pose; the ratio of scales of two pairs that share an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchslam.geometry import Camera, se3_inverse
from torchslam.geometry.robust import median_with_error
from torchslam.global_mapping.view_graph import ViewPair
from torchslam.types import FrameFeatures

MIN_PARALLAX_SIGMAS = 5.0
"""Parallax of a keypoint that takes part in a ratio, in units of its noise: below, inverse depths are biased."""
SIGMA_PX = 0.7
"""Noise of a parallax: that of a keypoint in either image."""
MIN_POINTS = 12
"""Least number of keypoints for a ratio of depths."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DepthRatio:
    """The inverse depths of one pair to those of another, of the same keypoints.

    Attributes:
        log_ratio: logarithm of the median ratio.
        std: its standard error.
    """

    log_ratio: float
    std: float


@dataclass(frozen=True)
class ViewRays:
    """The directions of all keypoints of images, computed once: an image is in many pairs.

    Attributes:
        views: unit directions in the camera, by image.
        focal: focal length of the camera, pixels.
    """

    views: Sequence[Float[Tensor, "_ 3"]]
    focal: float

    @classmethod
    def by(cls, camera: Camera, views: Sequence[FrameFeatures]) -> ViewRays:
        """The directions by a camera."""
        return cls([camera.unproject(view.keypoints) for view in views], float(camera.focal))

    def of(self, pair: ViewPair) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
        """The directions of the matches of a pair, in either camera."""
        return self.views[pair.first][pair.keypoints_1], self.views[pair.second][pair.keypoints_2]


@dataclass(frozen=True)
class PairDepths:
    """Inverse depths of the matches of a pair, as seen from its first and from its second image.

    Attributes:
        inverse: per keypoint of either image; NaN for those without a match.
        sigma: the noise of each.
    """

    inverse: tuple[Array, Array]
    sigma: tuple[Array, Array]

    @classmethod
    def of(cls, T_21: Float[Tensor, "4 4"], rays: ViewRays, pair: ViewPair) -> PairDepths:
        """The depths by a relative pose, in its unit."""
        x_1, x_2 = rays.of(pair)
        sigma = SIGMA_PX / rays.focal
        tables = []
        for T, own, other, keypoints, count in (
            (T_21, x_1, x_2, pair.keypoints_1, len(rays.views[pair.first])),
            (se3_inverse(T_21), x_2, x_1, pair.keypoints_2, len(rays.views[pair.second])),
        ):
            # other x (R own + inverse t) = 0, by least squares.
            along = torch.linalg.cross(other, own @ T[:3, :3].mT)
            across = torch.linalg.cross(other, T[:3, 3].expand_as(other))
            reach = across.norm(dim=-1)
            table = torch.full((2, count), torch.nan, dtype=own.dtype, device=own.device)
            table[0, keypoints] = -(along * across).sum(-1) / reach.square().clamp(min=1e-30)
            table[1, keypoints] = sigma / reach.clamp(min=1e-15)
            tables.append(table.cpu().numpy())
        return cls((tables[0][0], tables[1][0]), (tables[0][1], tables[1][1]))


def depth_ratio(one: PairDepths, at_one: int, other: PairDepths, at_other: int) -> DepthRatio | None:
    """Compare the inverse depths of the keypoints of a shared image by two pairs; None if too few can be compared.

    Args:
        one: of a pair.
        at_one: which of its images is shared, 0 or 1.
        other: of another pair, whose inverse depths are divided by those of the first.
        at_other: which of its images is shared.
    """
    a, b = one.inverse[at_one], other.inverse[at_other]
    sigma_a, sigma_b = one.sigma[at_one], other.sigma[at_other]
    common = ~np.isnan(a) & ~np.isnan(b)
    a, b, sigma_a, sigma_b = a[common], b[common], sigma_a[common], sigma_b[common]
    good = (a > MIN_PARALLAX_SIGMAS * sigma_a) & (b > MIN_PARALLAX_SIGMAS * sigma_b)
    if np.count_nonzero(good) < MIN_POINTS:
        return None
    center, _, error = median_with_error(np.log(b[good] / a[good]))
    return DepthRatio(center, error)
