"""Optical flow, or any dense matcher, in place of descriptors: its samples are the keypoints.

torchslam run IMAGES -o results --features examples.optical_flow:Samples --matcher examples.optical_flow:same
"""

from hashlib import blake2b

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from torchslam import Features, Matches
from torchslam.types import FrameFeatures

APART, LEAST, EDGE = 8, 0.005, 8  # pixels between samples; fraction of the best corner; pixels to the edge
RETURNS = 0.5  # pixels: limit of the forward-backward error


class Samples(torch.nn.Module):
    """Images (B, 1, H, W) in [0, 1], in temporal order, to Features: the flow carries samples from image to image, and
    new samples replace lost ones. The descriptor of a sample is its identifier."""

    def __init__(self, num_keypoints: int = 800) -> None:
        super().__init__()
        self.most, self.flow = num_keypoints, cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self.last = np.zeros((0, 0), np.uint8)
        self.at, self.names = np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)

    def carried(self, at: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Positions of pixels (n, 2) of the first image in the second. Replace it by your own dense matcher."""
        field = self.flow.calc(first, second, np.zeros((*first.shape, 2), np.float32))
        return at + np.asarray(cv2.remap(field, at[:, :1], at[:, 1:], cv2.INTER_LINEAR))[:, 0]

    def forward(self, images: torch.Tensor) -> Features:
        return Features.cat([self.of(image.mul(255).round().byte().numpy()) for image in images[:, 0]])

    def of(self, image: np.ndarray) -> Features:
        if len(self.at) and self.last.shape == image.shape:
            there = self.carried(self.at, self.last, image)
            good = np.linalg.norm(self.carried(there, image, self.last) - self.at, axis=1) < RETURNS
            good &= ((there >= EDGE) & (there < np.array(image.shape[::-1]) - EDGE)).all(1)
            self.at, self.names = there[good], self.names[good]
        self.last = image
        self.sample(image, self.most - len(self.at))
        missing = self.most - len(self.at)
        keypoints = F.pad(torch.from_numpy(self.at), (0, 0, 0, missing))[None]
        names = F.pad(torch.from_numpy(self.names), (0, 0, 0, missing))[None]
        ones, mask = torch.ones(1, self.most), (torch.arange(self.most) < len(self.at))[None]
        return Features(keypoints, ones * mask, ones, 0 * ones, names, mask)

    def sample(self, image: np.ndarray, count: int) -> None:
        """Add samples away from the others; identifiers are hashes of the first image and position."""
        free = np.full_like(image, 255)
        for x, y in self.at.round().astype(int).tolist():
            cv2.circle(free, (x, y), APART, 0, -1)
        found = cv2.goodFeaturesToTrack(image, count, LEAST, APART, mask=free) if count > 0 else None
        if found is not None:
            named = blake2b(image.tobytes()).digest()
            names = [blake2b(named + at.tobytes(), digest_size=32).digest() for at in found]
            self.at = np.concatenate([self.at, found[:, 0]])
            self.names = np.concatenate(
                [self.names, np.frombuffer(b"".join(names), np.uint8).reshape(-1, 32)]
            )


def same(view_1: FrameFeatures, view_2: FrameFeatures, prior: object) -> Matches:
    """Match the samples with equal identifiers."""
    first, second = (view.descriptors.contiguous().view(torch.int64) for view in (view_1, view_2))
    equal = (first[:, None] == second).all(-1) & view_1.mask[:, None] & view_2.mask
    rows, column = torch.arange(len(first)), equal.int().argmax(1)
    return Matches(rows[None], column[None], torch.zeros(1, len(rows)), equal.any(1)[None])
