"""From a frame to its features: the configured front end."""

from __future__ import annotations

from collections.abc import Callable

import torch

from torchslam.config import Config
from torchslam.errors import ConfigError
from torchslam.features import SimulatedFeatures, extractor
from torchslam.geometry import Camera
from torchslam.values import Features, Frame

Extractor = Callable[[Frame], Features]


def image_extractor(config: Config, device: torch.device | str = "cpu") -> Extractor:
    """The front end that reads images, on a device."""
    settings = config.features
    module = extractor(settings.kind, settings.num_keypoints, settings.weights or None).to(device)
    return lambda frame: module(frame.image.to(device))


def simulated_extractor(config: Config, camera: Camera, T_cw_groundtruth: torch.Tensor) -> Extractor:
    """Simulated features of a scene around the true poses (F, 4, 4)."""
    settings = config.simulated
    simulated = SimulatedFeatures(
        T_cw_groundtruth,
        camera,
        num_keypoints=config.features.num_keypoints,
        points_per_view=settings.points_per_view,
        depth_near=settings.depth_near,
        depth_far=settings.depth_far,
        noise_px=settings.noise_px,
        outliers=settings.outliers,
        dropout=settings.dropout,
        scales=settings.scales,
        seed=config.seed,
    )

    def extract(frame: Frame) -> Features:
        if frame.T_cw_groundtruth is None:
            raise ConfigError(f"simulated features need the true pose of every frame; {frame.name} has none")
        return simulated(frame.T_cw_groundtruth, frame.index)

    return extract
