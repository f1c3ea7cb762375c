"""From a frame to its features, by a feature extractor or by a simulation; checks of frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from inspect import signature

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchslam.config import Config
from torchslam.data.sequence import Sequence, Transformed
from torchslam.data.text_file import MAX_SECONDS
from torchslam.errors import ConfigError, FrameError
from torchslam.features import SimulatedFeatures
from torchslam.features.contract import apply_mask, check_features, check_gray
from torchslam.features.kornia_modules import KorniaFeatures, is_kornia_module
from torchslam.geometry import Camera
from torchslam.plugins import load_feature_extractor
from torchslam.types import Features, Frame

FeatureExtractor = Callable[..., Features]
"""Extracts features of images (B, 1, H, W), floats in [0, 1]: `ORB()`, `XFeat(weights)`, any module or function.

It may take a second argument: (B, 1, H, W) bool, where keypoints may lie. The same object serves `SLAM`, `ClipSLAM`
and, by its name, the command line.
"""

Extractor = Callable[[Frame], Features]
"""Extracts the features of a frame."""


def image_extractor(
    config: Config, device: torch.device | str = "cpu", extractor: FeatureExtractor | None = None
) -> Extractor:
    """Create the function from a frame to its features from an extractor of images, the configured one if None.

    It finds nothing under a frame's mask. Images that are larger than configured are reduced first, and keypoints and
    scales are given in pixels of the full image. The features are checked, see `check_features`.
    """
    settings = config.features
    if extractor is None:
        extractor = load_feature_extractor(settings.kind, settings.num_keypoints, settings.weights or None)
    if is_kornia_module(extractor):
        assert isinstance(extractor, nn.Module)
        extractor = KorniaFeatures(extractor, settings.num_keypoints)
    name = settings.kind if ":" in settings.kind else type(extractor).__name__
    if isinstance(extractor, nn.Module):
        extractor = extractor.to(device)
    takes_mask = _takes_two(extractor)

    def extract(frame: Frame) -> Features:
        image = frame.image.to(device)
        mask = None if frame.mask is None else frame.mask.to(device)
        height, width = image.shape[-2:]
        factor = settings.reduction((width, height))
        small, small_mask = reduced(image, mask, factor)
        features = extractor(small, small_mask) if takes_mask else extractor(small)
        check_features(features, small, name)
        if factor > 1:
            ratio = width / small.shape[-1], height / small.shape[-2]
            features = _enlarged(features, ratio, factor)
        # Refined to less than a pixel, keypoints at the edge may have moved beyond it.
        return features if mask is None else apply_mask(features, mask)

    return extract


class KeptFeatures:
    """The features of frames by their index, extracted once: who finds the camera and who maps use the same.

    Args:
        extract: extracts the features of a frame.
    """

    def __init__(self, extract: Extractor) -> None:
        self._extract = extract
        self._of: dict[int, Features] = {}

    def __call__(self, frame: Frame) -> Features:
        """The features of a frame; another frame of the same index has the same ones."""
        if frame.index not in self._of:
            self._of[frame.index] = self._extract(frame)
        return self._of[frame.index]

    def taken(self, frame: Frame) -> Features:
        """The features of a frame, which are not kept any longer."""
        features = self(frame)
        del self._of[frame.index]
        return features


def checked_extractor(config: Config, camera: Camera) -> Extractor:
    """Create the configured extractor, for frames that `check_size` accepts."""
    extract = image_extractor(config)

    def check_and_extract(frame: Frame) -> Features:
        check_size(frame, camera)
        return extract(frame)

    return check_and_extract


def _takes_two(extractor: FeatureExtractor) -> bool:
    """Whether a feature extractor takes a mask as second argument."""
    called = extractor.forward if isinstance(extractor, nn.Module) else extractor
    try:
        signature(called).bind(None, None)
    except TypeError:
        return False
    except ValueError:  # a builtin without a signature
        return False
    return True


def reduced(
    image: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None, factor: float
) -> tuple[Float[Tensor, "B 1 h w"], Bool[Tensor, "B 1 h w"] | None]:
    """Reduce an image and its mask by a factor."""
    height, width = image.shape[-2:]
    size = max(1, round(height / factor)), max(1, round(width / factor))
    if image.shape[-2:] == size:
        return image, mask
    if mask is not None:
        mask = F.interpolate(mask.float(), size, mode="nearest-exact") > 0
    # Bilinear reduction blurs: the corners of a reduced image would be others than those of a small one.
    return F.interpolate(image, size, mode="bicubic", antialias=True).clamp(0, 1), mask


def _enlarged(features: Features, ratio: tuple[float, float], factor: float) -> Features:
    """Features in pixels of an image that is wider and higher by a ratio."""
    size = features.keypoints.new_tensor(ratio)
    keypoints, information = (features.keypoints + 0.5) * size - 0.5, features.information
    if information is not None:
        is_matrix = information.ndim == 4
        information = information / (size[:, None] * size if is_matrix else size.prod())
    return replace(features, keypoints=keypoints, scales=factor * features.scales, information=information)


def check_size(frame: Frame, camera: Camera) -> None:
    """Check that image and mask have the size of the camera, and that the image is gray in [0, 1].

    Raises:
        FrameError: otherwise.
    """
    height, width = frame.image.shape[-2:]
    if (width, height) != camera.size:
        raise FrameError(
            f"{_name(frame)} has {width} x {height} pixels, the camera {camera.width} x {camera.height}"
        )
    check_gray(frame.image, _name(frame))
    if frame.mask is not None and frame.mask.shape != frame.image.shape:
        raise FrameError(f"{_name(frame)} has a mask of another shape, {tuple(frame.mask.shape)}")
    if frame.mask is not None and frame.mask.dtype != torch.bool:
        raise FrameError(
            f"{_name(frame)} has a mask of {frame.mask.dtype}, not torch.bool: compare it with 0"
        )


def check_order(frame: Frame, last: tuple[int, float] | None) -> None:
    """Check that a frame comes after the last one, by index and timestamp.

    Raises:
        FrameError: otherwise, or if the timestamp is not finite, or no seconds.
    """
    if not math.isfinite(frame.timestamp):
        raise FrameError(f"{_name(frame)} has the time {frame.timestamp}")
    if abs(frame.timestamp) >= MAX_SECONDS:
        raise FrameError(f"{_name(frame)} has the time {frame.timestamp:g}: times are seconds")
    if last is not None and (frame.index <= last[0] or frame.timestamp <= last[1]):
        raise FrameError(
            f"{_name(frame)}, frame {frame.index} at {frame.timestamp} s, does not come after "
            f"frame {last[0]} at {last[1]} s"
        )


def _name(frame: Frame) -> str:
    return frame.name or f"frame {frame.index}"


class Simulated:
    """Simulated features of a random scene around the true trajectory.

    Args:
        config: seed, number of keypoints and the scene.
        camera: the camera.
        T_cw_groundtruth: true poses, around which the scene is generated
    """

    def __init__(self, config: Config, camera: Camera, T_cw_groundtruth: Float[Tensor, "K 4 4"]) -> None:
        settings = config.simulated
        self._scene = SimulatedFeatures(
            T_cw_groundtruth,
            camera,
            num_keypoints=config.features.num_keypoints,
            points_per_view=settings.points_per_view,
            depth_near=settings.depth_near,
            depth_far=settings.depth_far,
            noise_px=settings.noise_px,
            outliers=settings.outlier_ratio,
            scales=settings.with_scales,
            seed=config.seed,
        )

    def __call__(self, frame: Frame) -> Features:
        """The features of a frame.

        Raises:
            ConfigError: if its true pose is unknown.
        """
        if frame.T_cw_groundtruth is None:
            raise ConfigError(f"simulated features need the true pose of every frame; {frame.name} has none")
        return self._scene(frame.T_cw_groundtruth, frame.index)

    def of(self, sequence: Sequence) -> Sequence:
        """The frames of a sequence with simulated features."""
        return WithFeatures(sequence, self)


class WithFeatures(Transformed):
    """A sequence whose frames bring features, extracted when they are read.

    The features have no gradient: who keeps them would keep all activations of a learned feature extractor.

    Args:
        extract: function from a frame to its features
    """

    def __init__(self, whole: Sequence, extract: Extractor) -> None:
        super().__init__(whole)
        self._extract = extract

    @property
    def brings_features(self) -> bool:
        """True: every frame has features."""
        return True

    def features(self, index: int) -> Features | None:
        """The features of the frame of an index."""
        return self[index].features

    @torch.no_grad()
    def __getitem__(self, index: int) -> Frame:
        frame = self._whole[index]
        return replace(frame, features=self._extract(frame))


def source(sequence: Sequence, config: Config, camera: Camera) -> Sequence:
    """The sequence as a run reads it: with simulated features if these are configured, else as it is.

    Args:
        camera: camera of the run, on its device

    Raises:
        ConfigError: for simulated features without true poses
    """
    if config.features.kind != "simulated" or sequence.brings_features:
        return sequence
    return Simulated(config, camera, true_poses(sequence)).of(sequence)


def true_poses(sequence: Sequence) -> Float[Tensor, "K 4 4"]:
    """The true poses, world to camera, of the frames that have one.

    Raises:
        ConfigError: if no frame has one.
    """
    frames = len(sequence) if sequence.groundtruth is not None else 0
    known = (sequence.pose(index) for index in range(frames))
    poses = [pose for pose in known if pose is not None]
    if not poses:
        raise ConfigError(
            f"{sequence.name} has no ground truth: simulated features need it; use --features orb"
        )
    return torch.stack(poses).to(torch.float64)
