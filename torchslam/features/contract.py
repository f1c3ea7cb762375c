"""The contract of feature extractors: checks of the features that they return, and masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchslam.errors import ConfigError, FrameError
from torchslam.geometry.gating import is_definite
from torchslam.types import Features
from torchslam.utils.torch_internals import in_transform

BINARY_BYTES = 32
"""Bytes of a binary descriptor, 256 bits."""

LENGTH_TOLERANCE = 0.02  # of descriptors: what half precision leaves of unit length
NORMALIZE = "torch.nn.functional.normalize(descriptors, dim=-1) makes them so"


@runtime_checkable
class FixedKeypoints(Protocol):
    """An extractor that can describe given keypoints again, after its parameters have changed: `XFeat`, `ALIKED`.

    Otherwise a row of its features may be another keypoint after every step of a training, since rows are sorted.
    """

    def read(
        self, images: Float[Tensor, "B 1 H W"], keypoints: Float[Tensor, "B N 2"], mask: Bool[Tensor, "B N"]
    ) -> Features:
        """The features of these keypoints, in these rows, each located anew near by."""
        ...


_OVER = 1e-3  # beyond black and white, of what resizing or training adds


def check_gray(images: Shaped[Tensor, "*batch"], name: str) -> None:
    """Check that images of any shape are floats in [0, 1]; `name`: of them, for messages.

    Raises:
        FrameError: They are of another kind, or have other values or NaN.
    """
    if not images.is_floating_point():
        raise FrameError(
            f"{name} must be floats in [0, 1], not {images.dtype}: divide by what is white, 255 for uint8"
        )
    if images.numel() == 0 or in_transform() or torch.compiler.is_compiling():
        return
    low, high = images.detach().aminmax()
    if not bool((low >= -_OVER) & (high <= 1 + _OVER)):  # also for NaN
        raise FrameError(f"{name} must be in [0, 1], these are from {float(low):g} to {float(high):g}")


def are_unit_or_zero(descriptors: Float[Tensor, "*batch D"]) -> Bool[Tensor, "*batch"]:
    """Whether float descriptors are finite and of unit length, or zero as those of no keypoint."""
    lengths = torch.linalg.vector_norm(descriptors.detach().float(), dim=-1)
    return ((lengths - 1).abs() <= LENGTH_TOLERANCE) | (lengths == 0)


def check_features(found: object, images: Shaped[Tensor, "B 1 H W"], name: str) -> None:
    """Check that what the feature extractor `name` returned for a batch of images keeps the contract of `Features`.

    Raises:
        ConfigError: A field has a wrong shape, type or value.
    """

    def refuse(what: str) -> None:
        raise ConfigError(f"feature extractor {name}: {what}")

    if not isinstance(found, Features):
        refuse(f"must return torchslam.Features, not {type(found).__name__}")
        return
    if not isinstance(found.keypoints, Tensor) or found.keypoints.ndim != 3:
        refuse(f"keypoints must be ({len(images)}, N, 2), not {_described(found.keypoints)}")
    rows = (len(images), found.keypoints.shape[1])
    for column in ("keypoints", "scores", "scales", "angles", "mask"):
        values = getattr(found, column)
        shape = (*rows, 2) if column == "keypoints" else rows
        if not isinstance(values, Tensor) or tuple(values.shape) != shape:
            refuse(f"{column} must be {shape}, not {_described(values)}")
        if not (values.dtype == torch.bool if column == "mask" else values.is_floating_point()):
            refuse(f"{column} must be {'bool' if column == 'mask' else 'floats'}, not {values.dtype}")
    described = found.descriptors
    if not isinstance(described, Tensor) or described.ndim != 3 or tuple(described.shape[:2]) != rows:
        refuse(f"descriptors must be {rows} + (D,), not {_described(described)}")
    if described.dtype != torch.uint8 and not described.is_floating_point():
        refuse(f"descriptors must be uint8, bits, or floats, not {described.dtype}")
    wanted = (*rows, BINARY_BYTES)
    if described.dtype == torch.uint8 and tuple(described.shape) != wanted:
        refuse(f"descriptors of bits must be {wanted}, {8 * BINARY_BYTES} bits, not {_described(described)}")
    if described.is_floating_point() and bool((wrong := ~are_unit_or_zero(described)).any()):
        lengths = described.detach().float().norm(dim=-1)[wrong]
        refuse(
            "descriptors of floats are compared by their cosine and must have length one, or zero where there is no "
            f"keypoint, not {float(lengths.min()):.3g} to {float(lengths.max()):.3g}; {NORMALIZE}"
        )
    for column in ("keypoints", "scales"):
        if not bool(getattr(found, column).isfinite().all()):
            refuse(f"{column} must be finite, also where mask is False")
    if bool(((found.scales <= 0) & found.mask).any()):
        refuse("scales must be positive")
    if found.information is not None:
        _check_information(found.information, found.mask, rows, refuse)


def _check_information(
    information: object, mask: Bool[Tensor, "B N"], rows: tuple[int, int], refuse: Callable[[str], None]
) -> None:
    """Check the shape and type of the information, and that it is positive (definite)."""
    shapes = (rows, (*rows, 2, 2))
    if not isinstance(information, Tensor) or tuple(information.shape) not in shapes:
        refuse(f"information must be {shapes[0]} or {shapes[1]}, not {_described(information)}")
    assert isinstance(information, Tensor)
    if not information.is_floating_point():
        refuse(f"information must be floats, not {information.dtype}")
    good = information > 0 if information.ndim == 2 else is_definite(information)
    if not bool((good & information.isfinite().reshape(*rows, -1).all(-1))[mask].all()):
        refuse("information must be positive, a matrix positive definite, where mask is True")


def _described(values: object) -> str:
    """Shape of a tensor, or type of another value, for messages."""
    return f"{tuple(values.shape)}" if isinstance(values, Tensor) else type(values).__name__


def apply_mask(features: Features, mask: Bool[Tensor, "B 1 H W"]) -> Features:
    """Mask the keypoints whose nearest pixel is not in the mask of an image.

    Pixels beyond the image count as those of its edge.
    """
    height, width = mask.shape[-2:]
    x, y = features.keypoints.detach().round().to(torch.int64).unbind(-1)
    inside = mask[:, 0].flatten(1).gather(1, y.clamp(0, height - 1) * width + x.clamp(0, width - 1))
    return replace(features, mask=features.mask & inside)


def check_images(images: Tensor, mask: Tensor | None = None) -> None:
    """Check the input of an extractor.

    Raises:
        ValueError: The images are not (B, 1, H, W) floats, or the mask is not (B, 1, H, W) bool.
        FrameError: The images are not in [0, 1].
    """
    if mask is not None and (mask.shape != images.shape or mask.dtype != torch.bool):
        raise ValueError(f"a mask must be bool {tuple(images.shape)}, got {mask.dtype} {tuple(mask.shape)}")
    if images.dim() != 4 or images.shape[1] != 1 or 0 in images.shape:
        raise ValueError(f"images must be (B, 1, H, W), got {tuple(images.shape)}")
    if images.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"images must be float32 or float64, in [0, 1], got {images.dtype}")
    check_gray(images, "images")
