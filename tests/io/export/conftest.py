"""A scene that is seen by four cameras, in every camera model."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchslam.geometry import Camera, rigid, so3_exp, transform
from torchslam.io.export.scene import ExportedScene

SIZE = (320, 240)
PINHOLE = (200.0, 210.0, 158.0, 121.5)
CAMERAS = {
    "pinhole": Camera.pinhole(*PINHOLE, size=SIZE),
    "tangential": Camera.radial_tangential(*PINHOLE, -0.2, 0.05, 0.002, -0.001, size=SIZE),
    "third": Camera.radial_tangential(*PINHOLE, -0.2, 0.05, 0.002, -0.001, 0.3, size=SIZE),
    "rational": Camera(
        "rational", torch.tensor([*PINHOLE, 0.5, -0.3, 2e-3, -1e-3, 0.1, 0.8, -0.1, 0.02]).double(), SIZE
    ),
    "fisheye": Camera.fisheye(*PINHOLE, 0.02, -0.01, 0.003, -0.001, size=SIZE),
}
NOISE_PX = 0.5


@pytest.fixture(params=CAMERAS)
def lens(request: pytest.FixtureRequest) -> Camera:
    """A camera of every model."""
    return CAMERAS[request.param]


@pytest.fixture
def scene(lens: Camera, generator: torch.Generator) -> ExportedScene:
    """Thirty points before four cameras, all of which see all of them but one; pixels are noisy."""
    frames, points = 4, 30
    noise = {"generator": generator, "dtype": torch.float64}
    T_cw = rigid(so3_exp(0.1 * torch.randn(frames, 3, **noise)), 0.3 * torch.randn(frames, 3, **noise))
    points_w = torch.rand(points, 3, **noise) * torch.tensor((3.0, 2.0, 2.0)) + torch.tensor((-1.5, -1, 4.0))
    frame_index = torch.arange(frames).repeat_interleave(points)[1:]
    point_index = torch.arange(points).repeat(frames)[1:]
    pixels, valid = lens.project(transform(T_cw, points_w.expand(frames, -1, -1)))
    assert valid.all()
    pixels = pixels.flatten(0, 1)[1:]
    return ExportedScene(
        camera=lens,
        frame_ids=torch.tensor((3, 5, 6, 90)),
        timestamps=torch.tensor((0.3, 0.5, 0.6, 9.0), dtype=torch.float64),
        is_keyframe=torch.tensor((True, False, True, True)),
        T_cw=T_cw,
        points_w=points_w,
        colors=torch.randint(0, 256, (points, 3), generator=generator, dtype=torch.uint8),
        frame_index=frame_index,
        point_index=point_index,
        pixels=pixels + NOISE_PX * torch.randn(pixels.shape, **noise),
    )


class PointErrors:
    """Mean over the points of their mean error, of pixels that another program would compute."""

    def __init__(self, points: int) -> None:
        self._total, self._count = np.zeros(points), np.zeros(points)

    def add(self, ids: np.ndarray, pixels: np.ndarray, keypoints: np.ndarray) -> None:
        np.add.at(self._total, ids, np.hypot(*(pixels - keypoints).T))
        np.add.at(self._count, ids, 1)

    def mean(self) -> float:
        return float(np.mean(self._total / self._count))


def reprojection_error(scene: ExportedScene) -> float:
    """Mean over the points of their mean error, point by point: what exports are compared with."""
    errors = []
    for point in range(len(scene.points_w)):
        seen = scene.point_index == point
        points_c = transform(scene.T_cw[scene.frame_index[seen]], scene.points_w[point].expand(1, 3))
        errors.append((scene.camera.project(points_c)[0][:, 0] - scene.pixels[seen]).norm(dim=-1).mean())
    return float(torch.stack(errors).mean())
