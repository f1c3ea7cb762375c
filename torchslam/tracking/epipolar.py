"""Matches along epipolar lines: keypoints of two views whose poses are known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchslam.features import expand_runs, match_pairs
from torchslam.geometry import Camera, KeypointNoise
from torchslam.map.map import NO_POINT, Map
from torchslam.types import Features, FrameFeatures


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

    Args:
        here: keypoints of the one keyframe.
        there: keypoints of the others.
        T_21: from the one camera to the others.
        camera: of all keyframes.
        epipolar_px: largest distance from the epipolar line, pixels.
        max_distance: of descriptors.

    Returns:
        Per match the row of the other view, and the rows in `here` and `there`, ordered by these three
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
    row, column = match_pairs(
        descriptors.expand(len(T_21), *descriptors.shape[1:]).flatten(0, 1),
        there.features.descriptors.flatten(0, 1),
        row,
        column,
        0.8 * max_distance,
    )
    return row // count, row % count, column % others


def angle_around_axis(
    axes: Float[Tensor, "K 3"], rays: Float[Tensor, "K N 3"]
) -> tuple[Float[Tensor, "K N"], Float[Tensor, "K N"]]:
    """Angles of rays around axes, radians, and the sines of their angles to these."""
    least = torch.nn.functional.one_hot(axes.abs().argmin(-1), 3).to(axes.dtype)
    across = torch.nn.functional.normalize(torch.linalg.cross(axes, least), dim=-1)
    other = torch.linalg.cross(torch.nn.functional.normalize(axes, dim=-1), across)
    x, y = (rays @ torch.stack((across, other), dim=-1)).unbind(-1)
    return torch.atan2(y, x), torch.hypot(x, y) / torch.linalg.vector_norm(rays, dim=-1)


def match_free(
    view_1: FrameFeatures,
    view_2: FrameFeatures,
    T_21: Float[Tensor, "4 4"],
    camera: Camera,
    epipolar_px: float,
    max_distance: float,
) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
    """Keypoints of two views, of those of their masks, that `match_along_epipolar_lines` finds."""
    one, two = (_of_view(view, camera) for view in (view_1, view_2))
    _, at_1, at_2 = match_along_epipolar_lines(one, two, T_21[None], camera, epipolar_px, max_distance)
    return one.rows[0, at_1], two.rows[0, at_2]


def _of_view(view: FrameFeatures, camera: Camera) -> FreeKeypoints:
    rows = torch.nonzero(view.mask)[:, 0]
    features = view.features.rows(rows)
    return FreeKeypoints(features, rows[None], camera.normalize(features.keypoints), view.noise[rows[None]])
