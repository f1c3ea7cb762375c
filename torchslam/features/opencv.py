"""ORB and SIFT of OpenCV behind the interface of `ORB`; both need no weights.

Lowe: Distinctive image features from scale-invariant keypoints (IJCV 2004). Descriptors of SIFT are root-normalized:
Arandjelovic and Zisserman: Three things everyone should know to improve object retrieval (CVPR 2012).
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from torch import Tensor, nn

from torchslam.features.contract import check_images
from torchslam.types import Features

OCTAVE_LAYERS, EDGE_THRESHOLD = 3, 10.0  # as Lowe has them
FIRST_SIGMA = 1.6  # blur of the first image of an octave, pixels of that octave; Lowe's as well

CONTRAST_THRESHOLD = 0.01
"""Contrast of a keypoint in images of 0 to 1, times the layers of an octave: OpenCV divides by them. Half of COLMAP's
0.02 / 3, a quarter of OpenCV's default: where texture is plenty, the strongest keypoints are the same, and between bare
walls (office_loop) there are half as many again. Tried 0.007 to 0.04. `LOCALIZATION` was measured at 0.02: with the
weaker keypoints the noise is up to 1.3 times that, within `RUN_NOISE`."""

LOCALIZATION, LEAST_SIZE = 0.025, 8.0
"""Standard deviation of a keypoint as a ratio of its size, the diameter of 2 sigma in pixels. Below 8 pixels it falls
no further, since the noise of the image limits it.

Measured by matches of eight images of garden and redkitchen with copies under five homographies, also at half the size,
with noise of two gray values added to both: 0.12 to 0.27 px up to size 8, and 0.02 to 0.036 of the size beyond. There
is no bias: keypoints of the flipped image are at W - 1 - x, with differences whose median is 0.000 px and whose mean is
at most 0.011 px, 0.001 px up to size 4.
"""

RUN_NOISE = 2.0
"""Noise of a keypoint in a run, in units of `LOCALIZATION`: views differ by more than a homography.

By the median residuals of runs over shelf_bin, fr2_desk_20, redkitchen, machine_hall and kitti07, the noise is 0.2 to
0.5 px up to size 8, and 0.03 to 0.06 of the size beyond. With 1.0, gates are so narrow that shelf_bin is soon lost."""

Array = NDArray[Any]


def gray_bytes(images: Float[Tensor, "B 1 H W"]) -> UInt8[Tensor, "B H W"]:
    """Images as OpenCV takes them, on the CPU."""
    return images.detach().mul(255).add(0.5).clamp(0, 255).to(torch.uint8)[:, 0].cpu()


class OpenCVORB(nn.Module):
    """OpenCV's ORB behind the interface of `ORB`. Not differentiable; results are on the images' device.

    Args:
        num_keypoints: largest number of keypoints per image; rows beyond what OpenCV finds are masked.
        scale_factor: ratio of the sizes of neighboring pyramid levels.
        num_levels: of the pyramid.
        threshold: of FAST, gray values of 0 to 255.
    """

    def __init__(
        self, num_keypoints: int = 1000, scale_factor: float = 1.2, num_levels: int = 8, threshold: int = 20
    ) -> None:
        super().__init__()
        self.num_keypoints = num_keypoints
        self.scale_factor = scale_factor
        self._orb = cv2.ORB.create(
            nfeatures=num_keypoints, scaleFactor=scale_factor, nlevels=num_levels, fastThreshold=threshold
        )

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        """Detect and describe keypoints; arguments, result and errors as for `ORB.forward`."""
        check_images(images, mask)
        masks = [None] * len(images) if mask is None else list(mask[:, 0].to(torch.uint8).cpu().numpy())
        batch = [self._extract(*each, images.dtype) for each in zip(gray_bytes(images), masks, strict=True)]
        fields = (torch.stack(column) for column in zip(*batch, strict=True))
        return Features(*fields).to(images.device)

    def _extract(self, image: Tensor, mask: np.ndarray | None, dtype: torch.dtype) -> tuple[Tensor, ...]:
        """The fields of `Features` of one (H, W) uint8 image, where `mask` is not 0."""
        # cv2 fails on images that leave no room for a keypoint instead of finding none.
        roomy = min(image.shape) > 2 * self._orb.getEdgeThreshold()
        found, described = self._orb.detectAndCompute(image.numpy(), mask) if roomy else ((), None)
        # cv2 may return a few more than asked for when responses tie.
        rows = sorted(range(len(found)), key=lambda row: -found[row].response)[: self.num_keypoints]
        values = torch.tensor([0, 0, 0, 1, 0], dtype=dtype, device="cpu").repeat(self.num_keypoints, 1)
        descriptors = torch.zeros(self.num_keypoints, 32, dtype=torch.uint8, device="cpu")
        found_mask = torch.arange(self.num_keypoints, device="cpu") < len(rows)
        if described is not None:
            points = [found[row] for row in rows]
            values[: len(rows)] = torch.tensor(
                [self._row(point) for point in points], dtype=dtype, device="cpu"
            )
            descriptors[: len(rows)] = torch.from_numpy(described[rows])
        return values[:, :2], values[:, 2], values[:, 3], values[:, 4], descriptors, found_mask

    def _row(self, point: cv2.KeyPoint) -> tuple[float, float, float, float, float]:
        """x, y, score, scale, angle of a keypoint.

        cv2 scales pixels of a level about the center of the first one, but resizes images about their corner; the
        difference is half a pixel of the level less half a pixel of the image.
        """
        scale = self.scale_factor**point.octave
        shift = (scale - 1) / 2
        angle = math.remainder(math.radians(point.angle), 2 * math.pi)
        return point.pt[0] + shift, point.pt[1] + shift, point.response, scale, angle


class SIFT(nn.Module):
    """OpenCV's SIFT: 128 floats per keypoint. Not differentiable; results are on the images' device, in their dtype.

    A place with several dominant orientations has a keypoint for each of them. The information of a keypoint is that of
    the noise that was measured for its size, see `RUN_NOISE`.

    Args:
        num_keypoints: largest number of keypoints per image; rows beyond what OpenCV finds are masked.
    """

    def __init__(self, num_keypoints: int = 2000) -> None:
        super().__init__()
        if num_keypoints < 1:
            raise ValueError(f"SIFT needs num_keypoints >= 1, not {num_keypoints}")
        self.num_keypoints = num_keypoints

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        """Detect and describe keypoints; arguments, result and errors as for `ORB.forward`."""
        check_images(images, mask)
        masks = [None] * len(images) if mask is None else list(mask[:, 0].to(torch.uint8).cpu().numpy())
        arrays = gray_bytes(images).numpy()
        batch = [self._extract(*each) for each in zip(arrays, masks, strict=True)]
        rows, descriptors = (torch.from_numpy(np.stack(column)) for column in zip(*batch, strict=True))
        x, y, size, angle, score = rows.unbind(-1)
        noise = RUN_NOISE * LOCALIZATION * size.clamp_min(LEAST_SIZE)
        return Features(
            torch.stack((x, y), dim=-1).to(images),
            score.to(images),
            # Where sigma is FIRST_SIGMA, the octave of the image itself begins. Finer keypoints, of the doubled image,
            # count as its pixels: search radii are multiples of the scale, and tuned for scales from 1.
            (size / (2 * FIRST_SIGMA)).clamp_min(1.0).to(images),
            torch.atan2(angle.sin(), angle.cos()).to(images),
            descriptors.to(images),
            (size > 0).to(images.device),
            noise.pow(-2).to(images),
        )

    def _extract(self, image: Array, mask: Array | None) -> tuple[Array, Array]:
        """x, y, size, angle, score (num_keypoints, 5), and descriptors of an (H, W) uint8 image; zero where none is.

        In order of falling score, then by place, size and angle, so that ties do not depend on OpenCV's order.
        """
        # OpenCV takes the strongest before it applies the mask, so with one it must return all.
        limit = self.num_keypoints if mask is None else 0
        # Without the precise upscale all keypoints are off by 0.25 px.
        options = OCTAVE_LAYERS, CONTRAST_THRESHOLD, EDGE_THRESHOLD, FIRST_SIGMA
        sift = cv2.SIFT.create(limit, *options, enable_precise_upscale=True)
        points, described = sift.detectAndCompute(image, mask)
        rows, descriptors = np.zeros((self.num_keypoints, 5)), np.zeros((self.num_keypoints, 128))
        if len(points):
            found = np.array(
                [(*each.pt, each.size, np.radians(each.angle), each.response) for each in points]
            )
            x, y, size, angle, score = found.T
            # OpenCV returns a few more than asked for when scores tie.
            order = np.lexsort((angle, size, y, x, -score))[: self.num_keypoints]
            rows[: len(order)] = found[order]
            descriptors[: len(order)] = root_normalized(described[order])
        return rows, descriptors


def root_normalized(descriptors: Array) -> Array:
    """Histograms (N, D) as vectors of unit length whose products are the Hellinger kernel; zero ones stay zero."""
    values = descriptors.astype(np.float64)
    normalized: Array = np.sqrt(values / np.maximum(values.sum(1, keepdims=True), np.finfo(np.float64).tiny))
    return normalized
