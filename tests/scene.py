"""A scene of points seen by cameras, and submaps that hold it exactly, so that every answer is known.

Rows are shuffled wherever they can be, so that a keypoint's number, a point's row and its place in the scene differ.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tests.map.simulated import estimate_at
from torchslam.config import Config
from torchslam.geometry import (
    Camera,
    SharedCamera,
    rigid,
    se3_exp,
    se3_inverse,
    sim3_inverse,
    sim3_scale,
    transform,
)
from torchslam.map.atlas import Submap
from torchslam.map.map import Map
from torchslam.mapping.local_bundle import AsyncBundleAdjustment
from torchslam.tracking.tracker import Tracker
from torchslam.types import FrameFeatures

CAMERA = Camera.pinhole(200.0, 200.0, 159.5, 119.5, size=(320, 240))
IDENTITY = torch.eye(4, dtype=torch.float64)


def pose(*tangent: float) -> Tensor:
    """(4, 4) from translation and rotation; omitted numbers are zero."""
    return se3_exp(torch.tensor([*tangent, *[0.0] * (6 - len(tangent))], dtype=torch.float64))


def sideways(count: int, step: float = 0.15, start: float = 0.0) -> Tensor:
    """(K, 4, 4) T_cw of cameras that look ahead, each a step to the right of the one before."""
    T_cw = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T_cw[:, 0, 3] = -(start + step * torch.arange(count, dtype=torch.float64))
    return T_cw


@dataclass(frozen=True)
class Scene:
    """points_w: (P, 3); sizes: (P,) map units; descriptors: (P, 32)."""

    points_w: Tensor
    sizes: Tensor
    descriptors: Tensor

    @classmethod
    def of(cls, count: int = 200, seed: int = 0, depth: float = 4.0, width: float = 8.0) -> Scene:
        """Draw points in a slab in front of the origin, of scales 1 to 3 px from there."""
        generator = torch.Generator().manual_seed(seed)
        draw = torch.rand(count, 4, generator=generator, dtype=torch.float64)
        extent = draw.new_tensor([width, 0.9 * depth, 0.5 * depth])
        points_w = (draw[:, :3] - 0.5) * extent + draw.new_tensor([0.0, 0.0, depth])
        descriptors = torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8)
        return cls(points_w, (1 + 2 * draw[:, 3]) * depth / 200.0, descriptors)

    def __len__(self) -> int:
        return len(self.points_w)

    def shows(self, index: int) -> Tensor:
        """(P,) the point of each keypoint of a view."""
        return torch.randperm(len(self), generator=torch.Generator().manual_seed(1000 + index))

    def at(self, index: int) -> Tensor:
        """(P,) the keypoint of each point in a view."""
        return torch.argsort(self.shows(index))

    def view(self, index: int, T_cw: Tensor, *, noise: float = 0.0, session: int = 0) -> FrameFeatures:
        """The features of a camera at T_cw (4, 4): a keypoint per visible point, with noise in units of its scale."""
        order = self.shows(index)
        points_c = transform(T_cw, self.points_w[order])
        pixels, valid = CAMERA.project(points_c)
        mask = valid & CAMERA.in_image(pixels)
        scales = self.sizes[order] * 200.0 / torch.linalg.vector_norm(points_c, dim=-1)
        generator = torch.Generator().manual_seed(2000 + index)
        error = noise * torch.randn(len(order), 2, generator=generator, dtype=torch.float64)
        return FrameFeatures(
            index=index,
            timestamp=0.1 * index,
            keypoints=torch.where(mask[:, None], pixels + scales[:, None] * error, 0.0),
            scales=torch.where(mask, scales, 1.0),
            angles=torch.zeros_like(scales),
            descriptors=self.descriptors[order],
            mask=mask,
            session=session,
        )


def rows_of(scene: Scene, seed: int = 0) -> Tensor:
    """(P,) the row in the map of each point of a scene."""
    return torch.randperm(len(scene), generator=torch.Generator().manual_seed(seed + 77))


def submap_of_scene(
    scene: Scene,
    T_cw: Tensor,
    *,
    S_ws: Tensor = IDENTITY,
    first: int = 0,
    number: int = 0,
    noise: float = 0.0,
    seen: Tensor | None = None,
) -> Submap:
    """Make a submap of the scene with keyframes at T_cw (K, 4, 4), frames first, first + 1, ....

    S_ws:  (4, 4) similarity from the scene to the submap
    seen:  (P,) bool, points that the map has; by default all. Row r of the map is point argsort(rows_of)[r].
    The tracker continues from the last keyframe.
    """
    submap = Submap.empty(number, CAMERA.params)
    rows = rows_of(scene)
    known = torch.ones(len(scene), dtype=torch.bool) if seen is None else seen
    ids: Tensor | None = None
    for offset, true in enumerate(T_cw):
        view = scene.view(first + offset, true, noise=noise)
        keyframe = submap.map.add_keyframe(view, moved(true, S_ws))
        if ids is None:
            order = torch.argsort(rows)
            ids = submap.map.add_points(
                transform(S_ws, scene.points_w[order]), scene.descriptors[order], keyframe
            )
        at = torch.nonzero(view.mask & known[scene.shows(first + offset)])[:, 0]
        submap.map.add_observations(keyframe, at, rows[scene.shows(first + offset)[at]])
        estimate = estimate_at(submap.map.T_cw[keyframe], rows[scene.shows(first + offset)[at]], at)
        submap.posed_frames.add(view, estimate, IDENTITY, keyframe)
    submap.map.update_appearance(torch.arange(len(T_cw)))
    lonely = torch.nonzero(submap.map.points["times_observed"] == 0)[:, 0]
    submap.map.remove_points(lonely)
    Tracker(SharedCamera(CAMERA), Config()).reset_to_keyframe(submap, len(T_cw) - 1)
    return submap


def moved(T_cw: Tensor, S_ws: Tensor) -> Tensor:
    """(..., 4, 4) the pose of a camera in a submap to which S_ws (4, 4) maps the scene."""
    S_cw = T_cw @ sim3_inverse(S_ws)
    scale = sim3_scale(S_cw)[..., None]
    return rigid(S_cw[..., :3, :3] / scale[..., None], S_cw[..., :3, 3] / scale)


def camera_center(T_cw: Tensor) -> Tensor:
    """(..., 3) centers of cameras."""
    return se3_inverse(T_cw)[..., :3, 3]


def with_scales(view: FrameFeatures, scales: Tensor) -> FrameFeatures:
    return replace(view, scales=scales)


def state_of(where: Submap) -> dict[str, object]:
    """Copies of all columns of a map, and of the tracking state."""
    state = {f"{name} of points": column.clone() for name, column in where.map.points.columns().items()}
    state |= {
        f"{name} of keyframes": column.clone() for name, column in where.map.keyframes.columns().items()
    }
    return state | copy.deepcopy(vars(where.tracking))


def assert_same_state(one: dict[str, object], two: dict[str, object]) -> None:
    assert one.keys() == two.keys()
    for name, value in one.items():
        if isinstance(value, Tensor):
            assert isinstance(two[name], Tensor), name
            assert torch.equal(value, two[name]), name
        else:
            assert value == two[name], name


def adjust_local(slam_map: Map, keyframe: int, camera: Camera) -> None:
    """Request a local bundle adjustment around a keyframe, and apply it at once."""
    adjusting = AsyncBundleAdjustment(SharedCamera(camera))
    adjusting.request(slam_map, keyframe, due=None)
    adjusting.apply(slam_map)
