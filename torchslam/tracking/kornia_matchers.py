"""Matchers of kornia as they are: of descriptors (`DescriptorMatcher`), or of regions as well (`LightGlueMatcher`)."""

from __future__ import annotations

from inspect import signature
from typing import Any, cast

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from torchslam.errors import ConfigError
from torchslam.features.kornia_modules import BLOB_RADIUS
from torchslam.features.matching.brute_force import best_of_each
from torchslam.features.matching.hamming import spread_bits
from torchslam.types import FrameFeatures, Matches, MatchPrior

MIN_KEYPOINTS = 2
"""Of a view: a ratio test needs a second neighbor."""


def make_kornia_matcher(kind: type[nn.Module], features: str, weights: str | None = None) -> KorniaMatcher:
    """Make the matcher of a class as kornia does by default, for the features of a name.

    Raises:
        ConfigError: kornia has no weights for these features, or a file with weights is given.
    """
    name = kind.__name__
    if weights is not None:
        raise ConfigError(f"matcher {name}: takes no weights from a file; `lightglue` does")
    if "feature_name" not in signature(kind).parameters:
        return KorniaMatcher(kind())
    modes: list[str] = cast(Any, kind).known_modes
    known = {mode.replace("_", ""): mode for mode in modes}
    mode = known.get(features.rpartition(":")[2].lower())
    if mode is None:
        raise ConfigError(
            f"matcher {name}: has no weights for the features {features!r}, but for {', '.join(modes)}"
        )
    return KorniaMatcher(kind(feature_name=mode))


class KorniaMatcher(nn.Module):
    """A matcher of kornia behind torchslam's interface; the prior is ignored.

    Regions are as large and turned as the keypoints, and round. Binary descriptors become floats of their bits. Where
    several keypoints match one of the second view, the best one is kept.

    Args:
        module: takes descriptors (N1, D) and (N2, D), and regions (LAFs) of both if its arguments are called so, and
            returns distances, or scores if it is a `LightGlueMatcher`, and rows of both (M, 2).

    Raises:
        ConfigError: The module takes something else, such as images.
    """

    def __init__(self, module: nn.Module) -> None:
        from kornia.feature import LightGlueMatcher

        super().__init__()
        self.module = module.eval()
        taken = signature(module.forward).parameters
        self._takes_lafs, self._takes_sizes = "lafs1" in taken, "hw1" in taken
        if "desc1" not in taken:
            raise ConfigError(
                f"matcher {type(module).__name__}: takes {', '.join(taken)}, not the descriptors of two views"
            )
        self.weighs = isinstance(module, LightGlueMatcher)
        """LightGlue's scores are weights."""

    @torch.no_grad()
    def forward(
        self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None = None
    ) -> Matches:
        """Match the keypoints of two views."""
        views = view_1, view_2
        rows = [torch.nonzero(view.mask)[:, 0] for view in views]
        if min(map(len, rows)) < MIN_KEYPOINTS:
            none = rows[0][:0][None]
            return Matches(none, none, none.float(), none.bool())
        given = [_floats(view.descriptors[at]) for view, at in zip(views, rows, strict=True)]
        if self._takes_lafs:
            given += [_lafs(view, at) for view, at in zip(views, rows, strict=True)]
        sizes = {}
        if self._takes_sizes:
            # Of both as far as the keypoints of either reach: projected points may lie outside of the image.
            width, height = torch.cat([lafs[0, :, :, 2] for lafs in given[2:]]).amax(0).ceil().int().tolist()
            sizes = {"hw1": (height + 1, width + 1), "hw2": (height + 1, width + 1)}
        found, pairs = self.module(*given, **sizes)[:2]
        first, second = pairs.unbind(-1)
        found = found[:, 0].float()
        distances = 1 - found if self.weighs else found
        mask = best_of_each(second, distances, len(rows[1]))
        matched = rows[0][first][None], rows[1][second][None], distances[None]
        if not self.weighs:
            return Matches(*matched, mask[None])
        return Matches(*matched, (mask & (found > 0))[None], weights=found.double()[None])


def _floats(descriptors: Shaped[Tensor, "N D"]) -> Float[Tensor, "N _"]:
    """Descriptors of unit length; squared distances of binary ones are proportional to their Hamming distances."""
    if descriptors.dtype != torch.uint8:
        return descriptors.float()
    bits = spread_bits(descriptors, 1).float()
    return bits / bits.shape[-1] ** 0.5


def _lafs(view: FrameFeatures, rows: Int[Tensor, " R"]) -> Float[Tensor, "1 R 2 3"]:
    """Round regions of keypoints, as `KorniaFeatures` reads them."""
    from kornia.feature import laf_from_center_scale_ori

    keypoints, scales = view.keypoints[rows].float(), view.scales[rows].float()
    angles = view.angles[rows].float().rad2deg()
    return laf_from_center_scale_ori(
        keypoints[None].clamp_min(0.0), (BLOB_RADIUS * scales)[None, :, None, None], angles[None, :, None]
    )
