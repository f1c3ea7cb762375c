"""Feature extractors of kornia as they are: any `LocalFeature`, DISK, and modules that return keypoints like theirs.

A module finds keypoints and descriptors; this turns them into `Features`: rows in order of falling score, padded to one
number, descriptors of unit length.
"""

from __future__ import annotations

from inspect import signature
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from torchslam.errors import ConfigError
from torchslam.features.weights import read_weights
from torchslam.types import Features

BLOB_RADIUS = 6.0 * 1.6
"""Radius of a region, pixels, at the finest level of kornia's detectors: 6 (`mr_size`) times a sigma of 1.6 pixels."""


def is_kornia_module(part: object) -> bool:
    """Whether a feature extractor is a module, or the class of a module, that kornia defines."""
    kind = part if isinstance(part, type) else type(part)
    return issubclass(kind, nn.Module) and kind.__module__.partition(".")[0] == "kornia"


def make_kornia_extractor(kind: type[nn.Module], num_keypoints: int, weights: str | None) -> KorniaFeatures:
    """Make the feature extractor of a class: with weights from a file, or those that kornia downloads for it.

    Raises:
        ConfigError: The weights do not fit.
    """
    if weights is None and (pretrained := getattr(kind, "from_pretrained", None)):
        return KorniaFeatures(pretrained(), num_keypoints)
    options = {"num_features": num_keypoints} if "num_features" in signature(kind).parameters else {}
    module = kind(**options)
    if weights is not None:
        try:
            module.load_state_dict(read_weights(weights))
        except RuntimeError as error:
            raise ConfigError(f"{weights}: no weights of kornia's {kind.__name__}: {error}") from None
    return KorniaFeatures(module, num_keypoints)


class KorniaFeatures(nn.Module):
    """A feature extractor of kornia behind torchslam's interface.

    Args:
        module: a `kornia.feature.LocalFeature`, or a module that returns, for each image, an object with keypoints
            (N, 2), descriptors (N, D) and scores (N,), as `kornia.feature.DISK` does.
        num_keypoints: largest number of keypoints per image, the best ones.
    """

    def __init__(self, module: nn.Module, num_keypoints: int = 1000) -> None:
        super().__init__()
        self.module, self.num_keypoints = module.eval(), num_keypoints

    def forward(self, images: Float[Tensor, "B 1 H W"]) -> Features:
        """Detect and describe keypoints.

        Args:
            images: gray, in [0, 1].

        Raises:
            ConfigError: The module returns something else.
        """
        from kornia.feature import LocalFeature

        if isinstance(self.module, LocalFeature):
            rows = [self._regions(image[None]) for image in images]
        else:
            rows = [self._points(found, images.shape[-2:]) for found in self._found(images)]
        return _padded(rows, self.num_keypoints)

    def _found(self, images: Tensor) -> list[Any]:
        height, width = images.shape[-2:]
        padded = F.pad(images, (0, -width % 16, 0, -height % 16), mode="replicate")  # as the networks need
        found = self.module(padded.expand(-1, 3, -1, -1))
        name = type(self.module).__name__
        if not isinstance(found, list | tuple) or len(found) != len(images):
            raise ConfigError(
                f"feature extractor {name}: must return one object per image, not {type(found).__name__}"
            )
        for each in found:
            if not (hasattr(each, "keypoints") and hasattr(each, "descriptors")) or _scores(each) is None:
                raise ConfigError(
                    f"feature extractor {name}: returns {type(each).__name__} without keypoints, descriptors and scores"
                )
        return list(found)

    def _points(self, found: Any, size: torch.Size) -> dict[str, Tensor]:
        """Rows of the keypoints inside of the image."""
        keypoints, scores = found.keypoints, _scores(found)
        assert scores is not None
        last = keypoints.new_tensor((size[1] - 1, size[0] - 1))
        is_inside = ((keypoints >= 0) & (keypoints <= last)).all(-1)
        keypoints, scores = keypoints[is_inside], scores[is_inside]
        return {
            "keypoints": keypoints,
            "scores": scores,
            "scales": torch.ones_like(scores),
            "angles": torch.zeros_like(scores),
            "descriptors": found.descriptors[is_inside],
        }

    def _regions(self, image: Tensor) -> dict[str, Tensor]:
        """Rows of the affine regions that a `LocalFeature` found in one image."""
        from kornia.feature import get_laf_center, get_laf_orientation, get_laf_scale, laf_is_filled

        lafs, scores, descriptors = self.module(image)
        is_there = laf_is_filled(lafs)[0]
        lafs = lafs[:, is_there]
        return {
            "keypoints": get_laf_center(lafs)[0],
            "scores": scores[0, is_there],
            "scales": (get_laf_scale(lafs)[0, :, 0, 0] / BLOB_RADIUS).clamp_min(1.0),
            "angles": get_laf_orientation(lafs)[0, :, 0].deg2rad(),
            "descriptors": descriptors[0, is_there],
        }


def _scores(found: Any) -> Tensor | None:
    """The scores of keypoints, which kornia's classes name differently."""
    given = (getattr(found, name, None) for name in ("detection_scores", "keypoint_scores", "scores"))
    return next((scores for scores in given if isinstance(scores, Tensor)), None)


def _padded(images: list[dict[str, Tensor]], count: int) -> Features:
    """The best rows of each image, in order of falling score."""
    columns: dict[str, list[Tensor]] = {}
    masks = []
    for rows in images:
        order = rows["scores"].detach().argsort(descending=True, stable=True)[:count]
        missing = count - len(order)
        rows = rows | {"descriptors": F.normalize(rows["descriptors"], dim=-1)}
        for name, values in rows.items():
            fill = (0, 0) * (values.ndim - 1) + (0, missing)
            columns.setdefault(name, []).append(F.pad(values[order].float(), fill))
        masks.append(torch.arange(count, device=order.device) < len(order))
    mask = torch.stack(masks)
    stacked = {name: torch.stack(values) for name, values in columns.items()}
    scales = torch.where(mask, stacked.pop("scales"), 1.0)
    return Features(scales=scales, mask=mask, **stacked)
