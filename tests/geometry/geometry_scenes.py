"""Synthetic scenes with known poses, noise and wrong matches, for the tests of the estimators."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from torchslam.geometry import Camera, rigid, se3_exp, se3_inverse, sim3_exp, so3_exp, transform

CAMERA = Camera.pinhole(525.0, 525.0, 319.5, 239.5, size=(640, 480))
RADIAL = Camera.radial_tangential(500.0, 520.0, 320.0, 240.0, -0.28, 0.07, 1e-3, -5e-4, 0.01, size=(640, 480))
FISHEYE = Camera.fisheye(300.0, 305.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, size=(640, 480))


@dataclass(frozen=True)
class Scene:
    """pixels_1, pixels_2: (1, N, 2); points_1: (1, N, 3); T_21: (1, 4, 4); mask: (1, N) right matches."""

    pixels_1: Tensor
    pixels_2: Tensor
    points_1: Tensor
    T_21: Tensor
    mask: Tensor


def two_views(
    seed: int,
    count: int = 200,
    outliers: float = 0.3,
    noise: float = 0.5,
    baseline: float = 0.35,
    plane: bool = False,
    camera: Camera = CAMERA,
) -> Scene:
    """Two views of a scene between 2 and 8 away, or of a slanted plane."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    size = torch.tensor(camera.size, dtype=torch.float64)
    omega, direction = 0.08 * normal(3), normal(3) * torch.tensor((1.0, 1.0, 0.3))
    T_21 = rigid(so3_exp(omega), baseline * direction / direction.norm())
    pixels = torch.rand(8 * count, 2, generator=generator, dtype=torch.float64) * size
    depth = 2 + 6 * torch.rand(8 * count, generator=generator, dtype=torch.float64)
    rays = camera.unproject(pixels)
    if plane:
        plane_normal = torch.tensor((0.3, -0.2, 1.0), dtype=torch.float64)
        depth = 4 * plane_normal.norm() / (rays / rays[:, 2:] @ plane_normal)
    points = rays / rays[:, 2:] * depth[:, None]
    projected, valid = camera.project(transform(T_21, points))
    rows = (valid & camera.in_image(projected)).nonzero().squeeze(-1)[:count]
    pixels_1 = pixels[rows] + noise * normal(count, 2)
    pixels_2 = projected[rows] + noise * normal(count, 2)
    wrong = torch.arange(count) < int(outliers * count)
    elsewhere = torch.rand(count, 2, generator=generator, dtype=torch.float64) * size
    pixels_2 = torch.where(wrong[:, None], elsewhere, pixels_2)
    return Scene(pixels_1[None], pixels_2[None], points[rows][None], T_21[None], ~wrong[None])


def many_views(seeds: Iterable[int], **options: Any) -> Scene:
    """A pair of views of a scene of its own for each seed."""
    scenes = [two_views(seed, **options) for seed in seeds]
    return Scene(*(torch.cat([getattr(scene, each.name) for scene in scenes]) for each in fields(Scene)))


def points_and_pixels(
    seed: int, count: int = 150, outliers: float = 0.3, noise: float = 0.5, camera: Camera = CAMERA
) -> tuple[Tensor, Tensor, Tensor]:
    """Points (1, N, 3) in world coordinates, their pixels (1, N, 2), and the camera's pose (1, 4, 4)."""
    generator = torch.Generator().manual_seed(seed)
    T_cw = se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))
    size = torch.tensor(camera.size, dtype=torch.float64)
    pixels = torch.rand(count, 2, generator=generator, dtype=torch.float64) * size
    depth = 1.5 + 6 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    rays = camera.unproject(pixels)
    points_w = transform(se3_inverse(T_cw), rays / rays[:, 2:] * depth)
    pixels = pixels + noise * torch.randn(count, 2, generator=generator, dtype=torch.float64)
    wrong = torch.arange(count) < int(outliers * count)
    elsewhere = torch.rand(count, 2, generator=generator, dtype=torch.float64) * size
    return points_w[None], torch.where(wrong[:, None], elsewhere, pixels)[None], T_cw[None]


@dataclass(frozen=True)
class Pairs:
    """The arguments of `estimate_similarity`, the answer (1, 4, 4), and the right pairs (1, N)."""

    points_1: Tensor
    points_2: Tensor
    pixels_1: Tensor
    pixels_2: Tensor
    S_21: Tensor
    right: Tensor

    def inputs(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.points_1, self.points_2, self.pixels_1, self.pixels_2


def make_pairs(
    seed: int,
    count: int = 120,
    outliers: float = 0.3,
    noise: float = 0.5,
    log_scale: float = 0.6,
    baseline: float = 0.8,
    camera_1: Camera = CAMERA,
    camera_2: Camera = CAMERA,
) -> Pairs:
    """Points seen by two cameras whose maps differ in scale, their depths uncertain by `noise` per cent."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    direction = normal(3) * torch.tensor((1.0, 1.0, 0.3))
    translation = baseline * math.exp(0.5 * log_scale) * direction / direction.norm()
    xi = torch.cat((translation, 0.08 * normal(3), torch.tensor((log_scale,))))
    S_21 = sim3_exp(xi)
    size = torch.tensor(camera_1.size, dtype=torch.float64)
    pixels_1 = torch.rand(8 * count, 2, generator=generator, dtype=torch.float64) * size
    rays = camera_1.unproject(pixels_1)
    depth = 2 + 4 * torch.rand(8 * count, 1, generator=generator, dtype=torch.float64)
    points_1 = rays / rays[:, 2:] * depth
    points_2 = transform(S_21, points_1)
    pixels_2, valid = camera_2.project(points_2)
    rows = (valid & camera_2.in_image(pixels_2)).nonzero().squeeze(-1)[:count]
    points_1, points_2, pixels_1, pixels_2 = (x[rows] for x in (points_1, points_2, pixels_1, pixels_2))
    wrong = torch.arange(count) < int(outliers * count)
    order = torch.cat((torch.arange(count)[wrong].roll(1), torch.arange(count)[~wrong]))
    points_2, pixels_2 = points_2[order], pixels_2[order]
    pixels_1, pixels_2 = pixels_1 + noise * normal(count, 2), pixels_2 + noise * normal(count, 2)
    points_1, points_2 = (x * (1 + 0.01 * noise * normal(count, 1)) for x in (points_1, points_2))
    tensors = (points_1, points_2, pixels_1, pixels_2, S_21, ~wrong)
    return Pairs(*(x[None] for x in tensors))


def rotation_error(R: Tensor, R_true: Tensor) -> float:
    """Largest angle between rotations, degrees."""
    chord = (R - R_true).flatten(-2).norm(dim=-1) / (2 * 2**0.5)
    return float(torch.rad2deg(2 * torch.asin(chord.clamp(max=1.0))).max())


def direction_error(t: Tensor, t_true: Tensor) -> float:
    """Largest angle between directions, degrees."""
    cosine = torch.nn.functional.cosine_similarity(t, t_true, dim=-1)
    return float(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).max())
