"""Simulated problems with known answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, transform
from torchslam.optim import BundleProblem

MODELS = ("pinhole", "radial_tangential", "fisheye")


def camera_of(model: str = "pinhole") -> Camera:
    if model == "pinhole":
        return Camera.pinhole(500.0, 510.0, 320.0, 240.0, size=(640, 480))
    if model == "radial_tangential":
        return Camera.radial_tangential(
            500.0, 510.0, 320.0, 240.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, size=(640, 480)
        )
    return Camera.fisheye(300.0, 310.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, size=(640, 480))


@pytest.fixture
def make_camera() -> Callable[[str], Camera]:
    return camera_of


class PoseScene(NamedTuple):
    """Truth, a start near it, points and their noisy pixels in `batch` views."""

    T_cw: Tensor
    start: Tensor
    points_w: Tensor
    pixels: Tensor
    camera: Camera


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def pose_scene() -> Callable[..., PoseScene]:
    def make(
        batch: int = 2,
        count: int = 40,
        noise: float = 0.5,
        outliers: float = 0.0,
        model: str = "pinhole",
        seed: int = 0,
        perturbation: float = 0.02,
    ) -> PoseScene:
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        camera = camera_of(model)
        T_cw = se3_exp(0.3 * normal(batch, 6))
        points_c = torch.stack(
            (normal(batch, count), 0.7 * normal(batch, count), 4 + normal(batch, count)), -1
        )
        points_c[..., 2].clamp_(min=2.0)
        points_w = transform(torch.linalg.inv(T_cw), points_c)
        pixels = camera.project(points_c)[0] + noise * normal(batch, count, 2)
        bad = int(outliers * count)
        pixels[:, :bad] += 40 * normal(batch, bad, 2)
        start = se3_exp(perturbation * normal(batch, 6)) @ T_cw
        return PoseScene(T_cw, start, points_w, pixels, camera)

    return make


class BundleScene(NamedTuple):
    """Truth, and a problem that starts near it."""

    T_cw: Tensor
    points_w: Tensor
    problem: BundleProblem


@pytest.fixture
def bundle_scene() -> Callable[..., BundleScene]:
    def make(
        frames: int = 5,
        points: int = 30,
        noise: float = 0.5,
        model: str = "pinhole",
        seed: int = 0,
        perturbation: float = 0.01,
        visible: float = 0.8,
        **options: object,
    ) -> BundleScene:
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        camera = camera_of(model)
        twists = 0.05 * normal(frames, 6)
        twists[:, 0] += torch.linspace(-1, 1, frames, dtype=torch.float64)
        T_cw = se3_exp(twists)
        points_w = torch.stack((1.2 * normal(points), normal(points), 5 + normal(points)), -1)
        points_w[:, 2].clamp_(min=3.0)
        seen = torch.rand(frames, points, generator=generator) < visible
        seen[:3] = True  # every point can be triangulated
        frame_index, point_index = seen.nonzero().unbind(-1)
        points_c = transform(T_cw[frame_index], points_w[point_index][:, None])[:, 0]
        pixels = camera.project(points_c)[0] + noise * normal(len(frame_index), 2)
        fixed = torch.zeros(frames, 1, dtype=torch.float64)
        fixed[2:] = perturbation
        problem = BundleProblem(
            se3_exp(fixed * normal(frames, 6)) @ T_cw,
            points_w + 3 * perturbation * normal(points, 3),
            frame_index,
            point_index,
            pixels,
            camera,
            **({"fixed_frames": (0, 1)} | options),
        )
        return BundleScene(T_cw, points_w, problem)

    return make
