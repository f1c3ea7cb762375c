"""The views of a run that get a depth map: poses, images at the resolution of the maps, range of depth, neighbors."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchslam.data.transforms import scale_camera
from torchslam.dense.estimate import choose_neighbors, neighbor_scores
from torchslam.errors import FrameError, ResultsError
from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.io.export.scene import ExportedScene, Images, undistorted
from torchslam.utils.files import fingerprint

NEIGHBORS = 12
"""Views that a depth map is compared with."""
SWEPT = 8
"""The best of them, which depth is estimated from."""
LEAST_NEIGHBORS = 2
"""With fewer a depth would not be confirmed."""
LEAST_POINTS = 10
"""Points of a view that its range of depth is taken from."""
QUANTILES = (0.02, 0.98)
"""Of the depth of the points of a view: a few points are outliers."""
NEARER, FARTHER = 0.75, 1.35
"""The range of depth reaches that much beyond the quantiles of the view's points."""
CACHED = 2 * NEIGHBORS
"""Images that are kept: consecutive views have most neighbors in common."""


@dataclass(frozen=True)
class Views:
    """Views with neighbors, in order of time.

    Attributes:
        frame_index: frames in the sequence.
        T_cw: poses.
        camera: the pinhole of the images.
        near, far: range of depth, map units.
        neighbors: of each view, indices of views, best first.
    """

    frame_index: Int[Tensor, " K"]
    T_cw: Float[Tensor, "K 4 4"]
    camera: Camera
    near: Float[Tensor, " K"]
    far: Float[Tensor, " K"]
    neighbors: tuple[tuple[int, ...], ...]

    def __len__(self) -> int:
        return len(self.frame_index)

    def fingerprint(self) -> str:
        """A digest of everything but the images."""
        tensors = (self.frame_index, self.T_cw, self.camera.params, self.near, self.far)
        numbers = [rows.contiguous().numpy().tobytes() for rows in tensors]
        return fingerprint([self.camera.size, self.neighbors, *numbers])

    def T_sr(self, view: int) -> Float[Tensor, "V 4 4"]:
        """Poses from the camera of a view to those of its neighbors."""
        return self.T_cw[list(self.neighbors[view])] @ se3_inverse(self.T_cw[view])

    def without(self, left_out: Collection[int]) -> Views:
        """The views without some of them, and without those that then have too few neighbors; possibly none."""
        kept = [view for view in range(len(self)) if view not in left_out]
        while True:  # a view that is left out is no neighbor of others
            place = {view: row for row, view in enumerate(kept)}
            near = (self.neighbors[view] for view in kept)
            neighbors = [tuple(place[other] for other in mine if other in place) for mine in near]
            enough = [len(mine) >= LEAST_NEIGHBORS for mine in neighbors]
            if all(enough):
                break
            kept = [view for view, fits in zip(kept, enough, strict=True) if fits]
        columns = {name: getattr(self, name)[kept] for name in ("frame_index", "T_cw", "near", "far")}
        return replace(self, **columns, neighbors=tuple(neighbors))


def readable(views: Views, images: Images) -> tuple[Views, list[str]]:
    """Leave out the views whose image cannot be read; also return what is wrong with each of these images.

    Raises ResultsError if fewer than three views are left.
    """
    wrong: dict[int, str] = {}
    for view, frame in enumerate(views.frame_index.tolist()):
        try:
            images.bgr(frame)
        except FrameError as error:
            wrong[view] = str(error)
    left = views.without(wrong)
    if len(left) <= LEAST_NEIGHBORS:
        first = next(iter(wrong.values()))
        raise ResultsError(
            f"{len(wrong)} of {len(views)} images cannot be read, the first one: {first}; the views left are too few "
            f"for dense depth, which needs {LEAST_NEIGHBORS + 1}"
        )
    return left, list(wrong.values())


class ViewImages:
    """Images of views, opened with the camera of the views; the last few are kept."""

    def __init__(self, views: Views, images: Images) -> None:
        self._views, self._images = views, images
        self._frames = views.frame_index.tolist()
        self.color = lru_cache(maxsize=CACHED)(self._color)

    def __reduce__(self) -> tuple[type[ViewImages], tuple[object, ...]]:
        return ViewImages, (self._views, self._images)

    def gray(self, view: int) -> Float[Tensor, "H W"]:
        """Gray image in [0, 1]. Raises FrameError if it cannot be read."""
        color = self.color(view).numpy()
        return torch.from_numpy(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)).float() / 255

    def _color(self, view: int) -> UInt8[Tensor, "H W 3"]:
        return torch.from_numpy(cv2.cvtColor(self._images.bgr(self._frames[view]), cv2.COLOR_BGR2RGB))


def views_of(scene: ExportedScene, size: tuple[int, int], every: int | None = None) -> Views:
    """Choose the views, and for each its range of depth and its neighbors.

    Views with few points, or without neighbors that see them from another direction, are left out.

    Args:
        scene: posed frames, with the observations of all of them.
        size: width and height of the depth maps.
        every: every N-th posed frame; None: the keyframes.

    Raises:
        ResultsError: fewer than three views are left.
    """
    scene = undistorted(scene)
    if every is None:
        frames, kind = torch.nonzero(scene.is_keyframe)[:, 0], "keyframes"
    else:
        frames, kind = torch.arange(0, len(scene.frame_ids), every, device="cpu"), "frames"
    if len(frames) <= LEAST_NEIGHBORS:
        raise ResultsError(
            f"dense depth needs {LEAST_NEIGHBORS + 1} views or more, and there are {len(frames)} {kind}: choose more "
            "posed frames (--every)"
        )
    T_cw = scene.T_cw[frames]
    centers_w = se3_inverse(T_cw)[:, :3, 3]
    seen = _seen(scene, frames)
    kept: list[int] = []
    ranges, neighbors = [], []
    for view, points in enumerate(seen):
        depth = transform(T_cw[view], scene.points_w[points])[:, 2]
        if len(points) < LEAST_POINTS:
            continue
        shared = torch.stack([torch.isin(points, other) for other in seen])
        shared[view] = False
        scores = neighbor_scores(scene.points_w[points], shared, centers_w[view], centers_w)
        order, is_there = choose_neighbors(scores, NEIGHBORS)
        if int(is_there.sum()) < LEAST_NEIGHBORS:
            continue
        kept.append(view)
        neighbors.append(order[is_there].tolist())
        ranges.append(depth.quantile(torch.tensor(QUANTILES, dtype=depth.dtype, device="cpu")))
    place = {view: row for row, view in enumerate(kept)}
    limits = torch.stack(ranges) if ranges else torch.empty(0, 2, dtype=torch.float32, device="cpu")
    rows = frames[kept]
    views = Views(
        frame_index=scene.frame_ids[rows],
        T_cw=scene.T_cw[rows],
        camera=scale_camera(scene.camera, size),
        near=limits[:, 0] * NEARER,
        far=limits[:, 1] * FARTHER,
        neighbors=tuple(tuple(place[other] for other in mine if other in place) for mine in neighbors),
    ).without(())
    if len(views) <= LEAST_NEIGHBORS:
        raise ResultsError(
            f"{len(views)} of {len(frames)} views see enough points of others from another direction; dense depth "
            f"needs {LEAST_NEIGHBORS + 1}: the camera must move sideways, or more frames be chosen (--every)"
        )
    return views


def _seen(scene: ExportedScene, frames: Tensor) -> list[Tensor]:
    """The points that each frame observes, ascending."""
    order = torch.argsort(scene.frame_index, stable=True)
    counts = torch.bincount(scene.frame_index, minlength=len(scene.frame_ids))
    parts = scene.point_index[order].split(counts.tolist())
    return [torch.unique(parts[frame]) for frame in frames.tolist()]
