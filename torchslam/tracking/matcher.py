"""Matching of two views: by descriptors, also near predictions and epipolar lines; checks of matchers from outside."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import normalize, one_hot, pad

from torchslam.config import MatchingConfig
from torchslam.errors import ConfigError
from torchslam.features import expand_runs, match, match_by_projection, match_pairs
from torchslam.features.kornia_modules import is_kornia_module
from torchslam.features.matching.brute_force import one_to_one
from torchslam.features.weights import MATCHER_OF
from torchslam.geometry import Camera, KeypointNoise
from torchslam.map.map import NO_POINT, Map
from torchslam.plugins import MATCHERS, instantiate, load
from torchslam.types import Features, Frame, FrameFeatures, Matcher, Matches, MatchIndices, MatchPrior


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
            return match(view_1.features, view_2.features, self.settings.max_ratio, max_distance=limit)
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
        one, two = (FreeKeypoints.of_view(view, prior.camera) for view in (view_1, view_2))
        T_21, width = prior.T_21[None], prior.epipolar_px
        _, at_1, at_2 = match_along_epipolar_lines(one, two, T_21, prior.camera, width, limit)
        rows, columns = one.rows[:, at_1], two.rows[:, at_2]
        distances = torch.zeros_like(rows, dtype=torch.float32)  # they are not used
        return Matches(rows, columns, distances, torch.ones_like(rows, dtype=torch.bool))


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
        from torchslam.tracking.learned_matchers import LightGlue

        return LightGlue(settings.weights or MATCHER_OF.get(features, "xfeat-lighterglue"), image_size)
    if matcher is None and settings.matcher != "descriptors":
        return _load(settings.matcher, features, settings.weights or None)
    if is_kornia_module(matcher):
        from torchslam.tracking.learned_matchers import KorniaMatcher

        return KorniaMatcher(matcher)  # type: ignore[arg-type]
    return DescriptorMatcher(settings) if matcher is None else matcher


def _load(name: str, features: str, weights: str | None) -> Matcher:
    """The matcher of a name: one of kornia's (`kornia:LightGlueMatcher`), or a plugin."""

    def make(kind: type, weights: str | None) -> Matcher:
        if is_kornia_module(kind):
            from torchslam.tracking.learned_matchers import make_kornia_matcher

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
    mask = one_to_one(column[None], nearest[None], (nearest <= radius_px)[None], len(view.mask))[0]
    first, second, apart = (torch.where(mask, values, 0)[None] for values in (rows, column, nearest))
    return Matches(first, second, apart.float(), mask[None])


@dataclass(frozen=True)
class FreeKeypoints:
    """The keypoints of keyframes that observe no point yet; where one has fewer than others, rows are masked out.

    Attributes:
        features: of the keypoints, a batch of K.
        rows: of the keyframes' keypoints.
        normalized: undistorted coordinates.
        noise: of the keypoints.
    """

    features: Features
    rows: Int[Tensor, "K N"]
    normalized: Float[Tensor, "K N 2"]
    noise: KeypointNoise

    @classmethod
    def of(
        cls, slam_map: Map, keyframes: Int[Tensor, " K"], normalize: Callable[[Tensor], Tensor]
    ) -> FreeKeypoints:
        """Those of keyframes; `normalize` maps pixels to undistorted coordinates."""
        table = slam_map.keyframes
        free = table["mask"][keyframes] & (table["point_ids"][keyframes] == NO_POINT)
        free, rows = torch.sort(free, dim=1, descending=True, stable=True)
        free = free[:, : int(free.sum(1).max())]
        rows = rows[:, : free.shape[1]]
        features = replace(slam_map.features(keyframes, rows), mask=free)
        noise = slam_map.keypoint_noise(keyframes[:, None], rows)
        return cls(features, rows, normalize(features.keypoints), noise)

    @classmethod
    def of_view(cls, view: FrameFeatures, camera: Camera) -> FreeKeypoints:
        """Those of the mask of a view."""
        rows = torch.nonzero(view.mask)[:, 0]
        features = view.features.rows(rows)
        return cls(features, rows[None], camera.normalize(features.keypoints), view.noise[rows[None]])


def match_along_epipolar_lines(
    here: FreeKeypoints,
    there: FreeKeypoints,
    T_21: Float[Tensor, "K 4 4"],
    camera: Camera,
    epipolar_px: float,
    max_distance: float,
) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"], Int[Tensor, " M"]]:
    """Keypoints of one keyframe and of K others that are each other's best on the epipolar line.

    The distance to the epipolar plane is the sine of an angle; a pixel is 1 / focal length of it. All these planes
    contain the baseline, so that a plane is an angle around it.

    Returns:
        Per match the row of the other view, and the rows in `here` and `there`, ordered by these three.
    """
    rays_1 = pad(here.normalized, (0, 1), value=1.0) @ T_21[:, :3, :3].mT
    (angles_1, _), (angles_2, sines) = (
        angle_around_axis(T_21[:, :3, 3], rays) for rays in (rays_1, pad(there.normalized, (0, 1), value=1.0))
    )
    width = epipolar_px / camera.focal * there.features.scales / sines.clamp(min=1e-12)
    width = torch.where(width < 1, torch.asin(width.clamp(max=1.0)), math.pi)
    # A window may reach over the end of a turn, so that angles stand a turn below and above as well. Both sides are
    # sorted: what is looked for next is near what was looked for last.
    count, others = angles_1.shape[1], angles_2.shape[1]
    which = torch.arange(len(T_21), device=width.device)[:, None]
    sorted_1, order_1 = angles_1.sort(dim=1, stable=True)
    sorted_2, order_2 = angles_2.sort(dim=1, stable=True)
    keys = torch.cat([sorted_1 + 2 * math.pi * turn for turn in (-1, 0, 1)], dim=1)
    rows = (torch.cat([order_1] * 3, dim=1) + which * count).flatten()
    width, mask = width.gather(1, order_2), there.features.mask.gather(1, order_2)
    left, right = (
        torch.searchsorted(keys, sorted_2 + sign * width) + which * keys.shape[1] for sign in (-1, 1)
    )
    at, place = expand_runs(left.flatten(), torch.where(mask, right, left).flatten())
    row, column = rows.index_select(0, place), (order_2 + which * others).flatten().index_select(0, at)
    descriptors = here.features.descriptors
    descriptors = descriptors.expand(len(T_21), *descriptors.shape[1:]).flatten(0, 1)
    row, column = match_pairs(
        descriptors, there.features.descriptors.flatten(0, 1), row, column, 0.8 * max_distance
    )
    return row // count, row % count, column % others


def angle_around_axis(
    axes: Float[Tensor, "K 3"], rays: Float[Tensor, "K N 3"]
) -> tuple[Float[Tensor, "K N"], Float[Tensor, "K N"]]:
    """Angles of rays around axes, radians, and the sines of their angles to these."""
    least = one_hot(axes.abs().argmin(-1), 3).to(axes.dtype)
    across = normalize(torch.linalg.cross(axes, least), dim=-1)
    other = torch.linalg.cross(normalize(axes, dim=-1), across)
    x, y = (rays @ torch.stack((across, other), dim=-1)).unbind(-1)
    return torch.atan2(y, x), torch.hypot(x, y) / torch.linalg.vector_norm(rays, dim=-1)
