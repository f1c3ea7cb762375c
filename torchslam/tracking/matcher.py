"""Matching of two views: the descriptor matcher, and the checks of matchers from outside."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.config import MatchingConfig
from torchslam.errors import ConfigError
from torchslam.features import match, match_by_projection
from torchslam.features.kornia_modules import is_kornia_module
from torchslam.features.matching.brute_force import best_of_each
from torchslam.features.weights import MATCHER_OF
from torchslam.plugins import MATCHERS, instantiate, load
from torchslam.tracking.epipolar import match_free
from torchslam.types import Frame, FrameFeatures, Matcher, Matches, MatchIndices, MatchPrior


class DescriptorMatcher:
    """Matches mutual nearest descriptors with the ratio test; with a prior, near a prediction or an epipolar line.

    See `types.Matcher`; a prior needs a radius, or a pose and a camera.
    """

    def __init__(self, settings: MatchingConfig) -> None:
        self.settings = settings

    def __call__(
        self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None = None
    ) -> Matches:
        limit = max_distance(view_2.descriptors, self.settings)
        if prior is None:
            return match(
                view_1.features,
                view_2.features,
                ratio=self.settings.max_ratio,
                mutual=True,
                max_distance=limit,
            )
        if prior.radius_px is not None:
            return match_by_projection(
                view_1.descriptors[None],
                view_1.keypoints[None],
                prior.radius_px[None],
                view_2.features,
                mask=view_1.mask[None],
                scales=view_1.scales[None],
                max_distance=limit,
                ratio=prior.ratio,
            )
        if prior.T_21 is None or prior.camera is None:
            raise ValueError("a prior needs radius_px, or T_21 and camera")
        rows, columns = match_free(view_1, view_2, prior.T_21, prior.camera, prior.epipolar_px, limit)
        return Matches(rows[None], columns[None], *_all_alike(rows))


def _all_alike(rows: Int[Tensor, " M"]) -> tuple[Float[Tensor, "1 M"], Bool[Tensor, "1 M"]]:
    """Distances and mask of pairs that all match; the distances are not used."""
    return rows.new_zeros(1, len(rows), dtype=torch.float32), torch.ones_like(rows, dtype=torch.bool)[None]


def max_distance(descriptors: Shaped[Tensor, "*batch N D"], settings: MatchingConfig) -> float:
    """The threshold for this kind of descriptor: bits, or 1 - cosine."""
    return settings.max_hamming_distance if descriptors.dtype == torch.uint8 else settings.max_cosine_distance


def make_matcher(
    settings: MatchingConfig,
    matcher: Matcher | None = None,
    image_size: tuple[int, int] | None = None,
    features: str = "",
) -> Matcher:
    """The given matcher, or else the configured one for images of a size (width, height) and a kind of features.

    One of kornia's gets torchslam's interface.

    Raises:
        ConfigError: if the name of the configured one is unknown, or kornia's takes no descriptors.
    """
    if matcher is None and settings.matcher == "lightglue":
        from torchslam.tracking.lightglue import LightGlue

        return LightGlue(settings.weights or MATCHER_OF.get(features, "xfeat-lighterglue"), image_size)
    if matcher is None and settings.matcher != "descriptors":
        return _load(settings.matcher, features, settings.weights or None)
    if is_kornia_module(matcher):
        from torchslam.tracking.kornia_matchers import KorniaMatcher

        return KorniaMatcher(matcher)  # type: ignore[arg-type]
    return DescriptorMatcher(settings) if matcher is None else matcher


def _load(name: str, features: str, weights: str | None) -> Matcher:
    """The matcher of a name: one of kornia's (`kornia:LightGlueMatcher`), or a plugin."""

    def make(kind: type, weights: str | None) -> Matcher:
        if is_kornia_module(kind):
            from torchslam.tracking.kornia_matchers import make_kornia_matcher

            return make_kornia_matcher(kind, features, weights)
        return instantiate(kind, weights=weights)

    return load(MATCHERS, name, make, weights=weights)


def prepare_view(view: FrameFeatures, frame: Frame, matcher: Matcher) -> FrameFeatures:
    """The view with what a matcher needs: the image, explicit noise that weights can multiply."""
    if getattr(matcher, "weighs", False):
        view = replace(view, information=view.noise.with_explicit_information().information)
    if getattr(matcher, "wants_images", False) and frame.image.numel():
        view = replace(view, image=frame.image)
    return view


def run_matcher(
    matcher: Matcher, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None = None
) -> MatchIndices:
    """Run a matcher.

    Raises:
        ConfigError: if its result is malformed.
    """
    found = matcher(view_1, view_2, prior)
    if not isinstance(matcher, DescriptorMatcher):
        check_matches(found, view_1, view_2, matcher)
    mask = found.mask[0]
    weights = None
    if found.weights is not None and getattr(matcher, "weighs", False):
        weights = found.weights[0][mask].to(view_2.keypoints)
    return MatchIndices(found.indices_1[0][mask], found.indices_2[0][mask], weights)


def check_matches(found: Any, view_1: FrameFeatures, view_2: FrameFeatures, matcher: object) -> None:
    """Check that `found` is `Matches` of two views that use each keypoint of the second once.

    Raises:
        ConfigError: otherwise.
    """
    name = getattr(matcher, "__name__", type(matcher).__name__)

    def refuse(what: str) -> None:
        raise ConfigError(f"matcher {name}: {what}")

    if not isinstance(found, Matches):
        refuse(f"must return torchslam.Matches, not {type(found).__name__}")
    shape = tuple(found.mask.shape)
    if len(shape) != 2 or shape[0] != 1 or found.mask.dtype != torch.bool:
        refuse(f"mask must be bool (1, M), not {found.mask.dtype} {shape}")
    for column, view in (("indices_1", view_1), ("indices_2", view_2)):
        rows = getattr(found, column)
        if tuple(rows.shape) != shape or rows.dtype != torch.int64:
            refuse(f"{column} must be int64 {shape}, not {rows.dtype} {tuple(rows.shape)}")
        rows = rows[found.mask]
        if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < len(view.mask):
            refuse(f"{column} must lie in 0 ... {len(view.mask) - 1}")
        if not bool(view.mask[rows].all()):
            refuse(f"{column} names rows that are no keypoints: only those of mask may match")
    second = found.indices_2[found.mask]
    if len(torch.unique(second)) != len(second):
        refuse("a keypoint of the second view is matched twice")
    if found.weights is not None:
        wrong = tuple(found.weights.shape) != shape or not found.weights.is_floating_point()
        if wrong or not bool((found.weights[found.mask] > 0).all()):
            refuse(f"weights must be positive floats {shape}")


def nearest_keypoints(
    pixels: Float[Tensor, "N 2"], rows: Int[Tensor, " N"], view: FrameFeatures, radius_px: float = 1.5
) -> Matches:
    """Convert the result of a dense matcher or optical flow to matches of keypoints.

    Each pixel is matched with the view's nearest keypoint within the radius, each keypoint with its nearest pixel.

    Args:
        pixels: in `view`, where keypoints of another view appear.
        rows: of these keypoints.
        view: the view with the keypoints.
        radius_px: largest distance between a pixel and its keypoint.
    """
    distances = torch.cdist(pixels.to(view.keypoints), view.keypoints).masked_fill(~view.mask, torch.inf)
    nearest, column = distances.min(1)
    mask = (nearest <= radius_px) & best_of_each(column, nearest, len(view.mask))
    return Matches(
        torch.where(mask, rows, 0)[None],
        torch.where(mask, column, 0)[None],
        torch.where(mask, nearest, 0.0)[None].float(),
        mask[None],
    )
