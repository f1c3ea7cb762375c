"""Recordings without images: points that cameras see, each with a descriptor of its own, so that every answer is known.

Rows are shuffled in each image, so that the number of a keypoint and that of its point differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.evaluation import ate
from torchslam.geometry import Camera, rigid, se3_exp, se3_inverse, so3_exp, so3_log, transform
from torchslam.global_mapping.rounds import ObservedTracks
from torchslam.global_mapping.tracks import Tracks
from torchslam.global_mapping.view_graph import Relation, ViewPair
from torchslam.types import FrameFeatures

CAMERA = Camera.pinhole(400.0, 400.0, 319.5, 239.5, size=(640, 480))
EYE = torch.eye(4, dtype=torch.float64)
SIGMA_PX = 0.5
"""Standard deviation of a keypoint of scale one."""


def rand(seed: int, *shape: int) -> Tensor:
    """Uniform numbers in [0, 1)."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def randn(seed: int, *shape: int) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def arc(count: int, degrees: float = 60.0, radius: float = 4.0) -> Tensor:
    """(K, 4, 4) T_cw of cameras on an arc around the origin, at which they look; they rise and fall a little."""
    angle = torch.linspace(-0.5, 0.5, count, dtype=torch.float64) * math.radians(degrees)
    zero = torch.zeros_like(angle)
    R_wc = so3_exp(torch.stack([zero, -angle, zero], -1))
    back = torch.tensor([0.0, 0.0, -radius], dtype=torch.float64)
    centers_w = R_wc @ back + torch.stack([zero, 0.05 * radius * torch.sin(7 * angle), zero], -1)
    return se3_inverse(rigid(R_wc, centers_w))


def line(count: int, step: float = 0.25) -> Tensor:
    """(K, 4, 4) T_cw of cameras that walk to the right, looking ahead, each a step from the one before."""
    T_cw = EYE.repeat(count, 1, 1)
    T_cw[:, 0, 3] = -step * torch.arange(count, dtype=torch.float64)
    return T_cw


def ball(count: int, seed: int = 0, radius: float = 1.0) -> Tensor:
    """(P, 3) points around the origin."""
    direction = torch.nn.functional.normalize(randn(seed, count, 3), dim=-1)
    return radius * rand(seed + 1, count, 1) ** (1 / 3) * direction


def wall(count: int, length: float, seed: int = 0) -> Tensor:
    """(P, 3) points at depths of 3 to 6 along a walk of this length to the right."""
    low = torch.tensor([-2.0, -1.5, 3.0], dtype=torch.float64)
    high = torch.tensor([length + 2.0, 1.5, 6.0], dtype=torch.float64)
    return low + (high - low) * rand(seed, count, 3)


@dataclass(frozen=True)
class Recording:
    """T_cw: (K, 4, 4); points_w: (P, 3); shows: (K, P) the point of each keypoint; views: those that cameras see."""

    T_cw: Tensor
    points_w: Tensor
    shows: Tensor
    views: list[FrameFeatures]

    @classmethod
    def of(
        cls,
        T_cw: Tensor,
        points_w: Tensor,
        noise_px: float = 0.0,
        wrong: float = 0.0,
        seed: int = 0,
        first: int = 100,
    ) -> Recording:
        """Look at points; a share of the keypoints of each image is elsewhere. `first`: index of the first frame."""
        generator = torch.Generator().manual_seed(seed)
        descriptors = torch.nn.functional.normalize(
            torch.randn(len(points_w), 64, generator=generator), dim=-1
        )
        shows = torch.stack([torch.randperm(len(points_w), generator=generator) for _ in T_cw])
        views = []
        for index, (T, order) in enumerate(zip(T_cw, shows, strict=True)):
            pixels, valid = CAMERA.project(transform(T, points_w[order]))
            mask = valid & CAMERA.in_image(pixels)
            pixels = pixels + noise_px * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
            far = torch.tensor([150.0, 110.0], dtype=torch.float64) * (
                1 + torch.rand(pixels.shape, generator=generator, dtype=torch.float64)
            )
            away = (pixels + far) % torch.tensor([639.0, 479.0], dtype=torch.float64)
            is_wrong = torch.arange(len(order)) < round(wrong * len(order))
            appearance = descriptors[order] + 0.02 * torch.randn(len(order), 64, generator=generator)
            views.append(
                FrameFeatures(
                    index=first + index,
                    timestamp=0.1 * index,
                    keypoints=torch.where(mask[:, None], torch.where(is_wrong[:, None], away, pixels), 0.0),
                    scales=torch.ones(len(order), dtype=torch.float64),
                    angles=torch.zeros(len(order), dtype=torch.float64),
                    descriptors=torch.nn.functional.normalize(appearance, dim=-1),
                    mask=mask,
                )
            )
        return cls(T_cw, points_w, shows, views)

    def __len__(self) -> int:
        return len(self.views)

    def at(self, view: int) -> Tensor:
        """(P,) the keypoint of each point in a view."""
        return torch.argsort(self.shows[view])

    def pair(self, first: int, second: int, relation: Relation = Relation.GENERAL) -> ViewPair:
        """All matches of two images, by point."""
        at_1, at_2 = self.at(first), self.at(second)
        both = self.views[first].mask[at_1] & self.views[second].mask[at_2]
        T_21 = self.T_cw[second] @ se3_inverse(self.T_cw[first])
        T_21[:3, 3] /= T_21[:3, 3].norm().clamp(min=1e-12)
        return ViewPair(first, second, at_1[both], at_2[both], T_21, relation)

    def pairs(self, *distances: int) -> list[ViewPair]:
        """The pairs at these distances, by first, then second image."""
        ends = [(row, row + distance) for row in range(len(self)) for distance in sorted(distances)]
        return [self.pair(*both) for both in ends if both[1] < len(self)]

    @property
    def tracks(self) -> Tracks:
        """One track per point that is seen, in the order of points."""
        seen = torch.stack([view.mask[self.at(row)] for row, view in enumerate(self.views)], 1)  # (P, K)
        point, view = seen.nonzero().unbind(-1)
        keypoint = torch.stack([self.at(row) for row in range(len(self))], 1)[point, view]
        return Tracks(torch.unique(point, return_inverse=True)[1], view, keypoint)

    @property
    def observed(self) -> ObservedTracks:
        """The tracks with their pixels."""
        return ObservedTracks.of(self.tracks, self.views)


def view_pair(first: int, second: int, *matches: tuple[int, int]) -> ViewPair:
    """A pair with these matches of keypoints."""
    at_1, at_2 = (torch.tensor([match[side] for match in matches], dtype=torch.int64) for side in (0, 1))
    return ViewPair(first, second, at_1, at_2, EYE, Relation.GENERAL)


def disturbed(T_cw: Tensor, distance: float, degrees: float, seed: int = 0) -> Tensor:
    """Poses that are off by so much, each by itself and in a random direction."""
    step = torch.nn.functional.normalize(randn(seed, len(T_cw), 2, 3), dim=-1)
    return se3_exp(torch.cat([distance * step[:, 0], math.radians(degrees) * step[:, 1]], -1)) @ T_cw


def degrees_between(R: Tensor, other: Tensor) -> Tensor:
    """Angles between rotations."""
    return torch.rad2deg(so3_log(R @ other.mT).norm(dim=-1))


def apart(T_cw: Tensor, truth: Tensor) -> tuple[float, float]:
    """How far poses are from true ones: the ATE up to a similarity, the largest error of a rotation in degrees."""
    R, true = T_cw[:, :3, :3], truth[:, :3, :3]
    turns = degrees_between(R @ R[:1].mT, true @ true[:1].mT)
    return float(ate(T_cw=T_cw, T_cw_groundtruth=truth)), float(turns.max())
