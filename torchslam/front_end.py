"""From a frame to its features: the configured front end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from torchslam.config import Config
from torchslam.errors import ConfigError, FrameError
from torchslam.features import SimulatedFeatures, extractor
from torchslam.features.masking import only_where
from torchslam.geometry import Camera
from torchslam.values import Features, Frame

Extractor = Callable[[Frame], Features]


def image_extractor(config: Config, device: torch.device | str = "cpu") -> Extractor:
    """The front end that reads images, on a device; under a frame's mask it finds nothing.

    Much larger images than configured it reduces first, and its keypoints and their scales grow back.
    """
    settings = config.features
    module = extractor(settings.kind, settings.num_keypoints, settings.weights or None).to(device)

    def extract(frame: Frame) -> Features:
        image = frame.image.to(device)
        wanted = None if frame.mask is None else frame.mask.to(device)
        height, width = image.shape[-2:]
        factor = settings.reduction((width, height))
        small, wanted_there = reduced(image, wanted, factor)
        features = module(small, wanted_there)
        if factor > 1:
            ratio = width / small.shape[-1], height / small.shape[-2]
            features = _enlarged(features, ratio, factor)
        # Refined to less than a pixel, keypoints at the edge may have moved beyond it.
        return features if wanted is None else only_where(features, wanted)

    return extract


def reduced(image: Tensor, wanted: Tensor | None, factor: float) -> tuple[Tensor, Tensor | None]:
    """An image and the mask of it, less wide and high by a factor."""
    height, width = image.shape[-2:]
    size = max(1, round(height / factor)), max(1, round(width / factor))
    if image.shape[-2:] == size:
        return image, wanted
    if wanted is not None:
        wanted = F.interpolate(wanted.float(), size, mode="nearest-exact") > 0
    # Bilinear reduction blurs: the corners of a reduced image would be others than those of a small one.
    return F.interpolate(image, size, mode="bicubic", antialias=True).clamp(0, 1), wanted


def _enlarged(features: Features, ratio: tuple[float, float], factor: float) -> Features:
    """Features in pixels of an image that is wider and higher by a ratio."""
    size = features.keypoints.new_tensor(ratio)
    keypoints, information = (features.keypoints + 0.5) * size - 0.5, features.information
    if information is not None:
        is_matrix = information.ndim == 4
        information = information / (size[:, None] * size if is_matrix else size.prod())
    return replace(features, keypoints=keypoints, scales=factor * features.scales, information=information)


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
