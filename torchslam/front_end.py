"""From a frame to its features: the configured front end."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from torchslam.config import Config
from torchslam.errors import ConfigError, FrameError
from torchslam.features import SimulatedFeatures, extractor
from torchslam.features.masking import only_where
from torchslam.geometry import Camera
from torchslam.values import Features, Frame

Extractor = Callable[[Frame], Features]


def image_extractor(config: Config, device: torch.device | str = "cpu") -> Extractor:
    """The front end that reads images, on a device; under a frame's mask it finds nothing."""
    settings = config.features
    module = extractor(settings.kind, settings.num_keypoints, settings.weights or None).to(device)

    def extract(frame: Frame) -> Features:
        if frame.mask is None:
            return module(frame.image.to(device))
        wanted = frame.mask.to(device)
        # Refined to less than a pixel, keypoints at the edge may have moved beyond it.
        return only_where(module(frame.image.to(device), wanted), wanted)

    return extract


def check_size(frame: Frame, camera: Camera) -> None:
    """Raises FrameError where the image has not the size that the camera has."""
    height, width = frame.image.shape[-2:]
    if (width, height) != camera.size:
        raise FrameError(
            f"{_name(frame)} has {width} x {height} pixels, the camera {camera.width} x {camera.height}"
        )
    if frame.mask is not None and frame.mask.shape != frame.image.shape:
        raise FrameError(f"{_name(frame)} has a mask of another shape, {tuple(frame.mask.shape)}")


def check_order(frame: Frame, last: tuple[int, float] | None) -> None:
    """Raises FrameError where a frame does not come after the last one, by index and timestamp, or has no time."""
    if not math.isfinite(frame.timestamp):
        raise FrameError(f"{_name(frame)} has the time {frame.timestamp}")
    if last is not None and (frame.index <= last[0] or frame.timestamp <= last[1]):
        raise FrameError(
            f"{_name(frame)}, frame {frame.index} at {frame.timestamp} s, does not come after "
            f"frame {last[0]} at {last[1]} s"
        )


def _name(frame: Frame) -> str:
    return frame.name or f"frame {frame.index}"


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
