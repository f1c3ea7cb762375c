"""The contract of front ends: checks of the features that they return, and masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchslam.errors import ConfigError
from torchslam.geometry.gating import is_definite
from torchslam.types import Features

COLUMNS: dict[str, tuple[int, ...]] = {
    "keypoints": (2,),
    "scores": (),
    "scales": (),
    "angles": (),
    "mask": (),
}
"""The shape of one keypoint's row."""
BYTES = 32
"""Bytes of a binary descriptor: matching and the keyframe database count 256 bits."""

LENGTH_TOLERANCE = 0.02  # of descriptors: what half precision leaves of unit length
NORMALIZE = "torch.nn.functional.normalize(descriptors, dim=-1) makes them so"


def are_comparable(descriptors: Tensor) -> Tensor:
    """(..., N) bool, which rows of floats (..., N, D) the cosine compares: finite, of unit length, or zero as those of
    no keypoint."""
    lengths = torch.linalg.vector_norm(descriptors.detach().float(), dim=-1)
    return ((lengths - 1).abs() <= LENGTH_TOLERANCE) | (lengths == 0)


def check_features(found: object, images: Tensor, name: str) -> None:
    """Raises ConfigError where a front end's answer to images (B, 1, H, W) is not `Features` of B images."""

    def refuse(what: str) -> None:
        raise ConfigError(f"front end {name}: {what}")

    if not isinstance(found, Features):
        refuse(f"must return torchslam.Features, not {type(found).__name__}")
        return
    if not isinstance(found.keypoints, Tensor) or found.keypoints.ndim != 3:
        refuse(f"keypoints must be ({len(images)}, N, 2), not {_described(found.keypoints)}")
    rows = (len(images), found.keypoints.shape[1])
    for column, shape in COLUMNS.items():
        values = getattr(found, column)
        if not isinstance(values, Tensor) or tuple(values.shape) != (*rows, *shape):
            refuse(f"{column} must be {(*rows, *shape)}, not {_described(values)}")
        if not (values.dtype == torch.bool if column == "mask" else values.is_floating_point()):
            refuse(f"{column} must be {'bool' if column == 'mask' else 'floats'}, not {values.dtype}")
    described = found.descriptors
    if not isinstance(described, Tensor) or described.ndim != 3 or tuple(described.shape[:2]) != rows:
        refuse(f"descriptors must be {rows} + (D,), not {_described(described)}")
    if described.dtype != torch.uint8 and not described.is_floating_point():
        refuse(f"descriptors must be uint8, bits, or floats, not {described.dtype}")
    if described.dtype == torch.uint8 and described.shape[-1] != BYTES:
        refuse(f"descriptors of bits must be {(*rows, BYTES)}, {8 * BYTES} bits, not {_described(described)}")
    if described.is_floating_point():
        _check_lengths(described, refuse)
    for column in ("keypoints", "scales"):
        if not bool(getattr(found, column).isfinite().all()):
            refuse(f"{column} must be finite, also where mask is False")
    if bool(((found.scales <= 0) & found.mask).any()):
        refuse("scales must be positive")
    if found.information is not None:
        _check_information(found.information, found.mask, rows, refuse)


def _check_lengths(descriptors: Tensor, refuse: Callable[[str], None]) -> None:
    wrong = ~are_comparable(descriptors)
    if bool(wrong.any()):
        lengths = descriptors.detach().float().norm(dim=-1)[wrong]
        refuse(
            "descriptors of floats are compared by their cosine and must have length one, or zero where there is no "
            f"keypoint, not {float(lengths.min()):.3g} to {float(lengths.max()):.3g}; {NORMALIZE}"
        )


def _check_information(
    information: object, mask: Tensor, rows: tuple[int, int], refuse: Callable[[str], None]
) -> None:
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
    return f"{tuple(values.shape)}" if isinstance(values, Tensor) else type(values).__name__


def only_where(features: Features, wanted: Tensor) -> Features:
    """Features without the keypoints whose nearest pixel is not wanted; pixels beyond the image count as its edge.

    Args:
        wanted: (B, 1, H, W) bool.
    """
    height, width = wanted.shape[-2:]
    x, y = features.keypoints.detach().round().to(torch.int64).unbind(-1)
    inside = wanted[:, 0].flatten(1).gather(1, y.clamp(0, height - 1) * width + x.clamp(0, width - 1))
    return replace(features, mask=features.mask & inside)
