"""OpenCV's ORB behind the same interface as `ORB`: the reference, and an alternative extractor on the CPU."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from torchslam.features.orb import check_images
from torchslam.types import Features


class OpenCVORB(nn.Module):
    """cv2.ORB for batches of images. Not differentiable; results come back on the images' device.

    num_keypoints: keypoints per image, at most; rows beyond what OpenCV finds are masked
    scale_factor, num_levels, threshold: of the pyramid and of FAST (grey values of 0 to 255), as cv2.ORB has them
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

    def forward(self, images: Tensor, wanted: Tensor | None = None) -> Features:
        """Detect and describe: (B, 1, H, W) floats in [0, 1] -> Features with N = num_keypoints rows.

        wanted: (B, 1, H, W) bool, where keypoints may lie; None: everywhere

        Raises ValueError for another shape or type.
        """
        check_images(images, wanted)
        masks = [None] * len(images) if wanted is None else list(wanted[:, 0].to(torch.uint8).cpu().numpy())
        arrays = images.detach().mul(255).add(0.5).clamp(0, 255).to(torch.uint8)[:, 0].cpu()
        batch = [self._extract(*each, images.dtype) for each in zip(arrays, masks, strict=True)]
        fields = (torch.stack(column) for column in zip(*batch, strict=True))
        return Features(*fields).to(images.device)

    def _extract(self, image: Tensor, mask: np.ndarray | None, dtype: torch.dtype) -> tuple[Tensor, ...]:
        """The fields of `Features` of one (H, W) uint8 image, where `mask` is not 0."""
        # cv2 fails on images that leave no room for a keypoint instead of finding none.
        roomy = min(image.shape) > 2 * self._orb.getEdgeThreshold()
        found, described = self._orb.detectAndCompute(image.numpy(), mask) if roomy else ((), None)
        # cv2 may return a few more than asked for when responses tie.
        rows = sorted(range(len(found)), key=lambda row: -found[row].response)[: self.num_keypoints]
        values = torch.tensor([0, 0, 0, 1, 0], dtype=dtype).repeat(self.num_keypoints, 1)
        descriptors = torch.zeros(self.num_keypoints, 32, dtype=torch.uint8)
        found_mask = torch.arange(self.num_keypoints) < len(rows)
        if described is not None:
            points = [found[row] for row in rows]
            values[: len(rows)] = torch.tensor([self._row(point) for point in points], dtype=dtype)
            descriptors[: len(rows)] = torch.from_numpy(described[rows])
        return values[:, :2], values[:, 2], values[:, 3], values[:, 4], descriptors, found_mask

    def _row(self, point: cv2.KeyPoint) -> tuple[float, float, float, float, float]:
        """x, y, score, scale, angle of a keypoint.

        cv2 scales pixels of a level about the centre of the first one, but resizes images about their corner; the
        difference is half a pixel of the level less half a pixel of the image.
        """
        scale = self.scale_factor**point.octave
        shift = (scale - 1) / 2
        angle = math.remainder(math.radians(point.angle), 2 * math.pi)
        return point.pt[0] + shift, point.pt[1] + shift, point.response, scale, angle
