"""A textured plane, images of it from any pose, and a submap that knows some of its points."""

from __future__ import annotations

from typing import Self

import cv2
import numpy as np
import torch
from torch import Tensor

from tests.map.simulated import CAMERA, estimate_at, view_of
from tests.scene import sideways
from torchslam.geometry import se3_inverse, transform
from torchslam.map.atlas import Submap
from torchslam.metric.source import SubmapView

TEXELS = 100.0  # per unit of the plane


class PlaneWorld:
    """The plane normal_w . p = offset, with a smooth random texture along two axes.

    T_cw:  (F, 4, 4)
    """

    brings_features = False

    def __init__(self, T_cw: Tensor, normal_w: Tensor, offset: float) -> None:
        self.T_cw, self.normal_w, self.offset = T_cw, normal_w, offset
        texture = np.random.default_rng(0).uniform(0, 1, (2000, 2000)).astype(np.float32)
        texture = cv2.GaussianBlur(texture, (0, 0), 4.0)
        self.texture = (texture - texture.min()) / (texture.max() - texture.min())
        axis = torch.tensor((1.0, 0.0, 0.0), dtype=torch.float64)
        self.axes = torch.stack((axis, torch.linalg.cross(normal_w, axis)))

    @classmethod
    def slanted(cls, frames: int = 9) -> Self:
        """A slanted wall, from four to five units ahead."""
        normal_w = torch.nn.functional.normalize(torch.tensor([0.2, 0.1, 1.0], dtype=torch.float64), dim=0)
        return cls(sideways(frames), normal_w, 4.5)

    def points_w(self, index: int, pixels: Tensor) -> Tensor:
        """(N, 3) where the rays of pixels (N, 2) of a frame meet the plane; far behind it above the horizon."""
        T_wc = se3_inverse(self.T_cw[index])
        rays_w = CAMERA.unproject(pixels) @ T_wc[:3, :3].mT
        slope = rays_w @ self.normal_w
        length = (self.offset - self.normal_w @ T_wc[:3, 3]) / torch.where(slope.abs() > 1e-3, slope, 1e-3)
        return T_wc[:3, 3] + torch.where(length > 0, length, 1e3)[:, None] * rays_w

    def image(self, index: int) -> Tensor:
        width, height = CAMERA.size
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        points_w = self.points_w(index, torch.stack((x, y), dim=-1).reshape(-1, 2).double())
        u, v = (
            (TEXELS * (points_w @ axis) + 1000).reshape(height, width).float().numpy() for axis in self.axes
        )
        sampled = cv2.remap(self.texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return torch.from_numpy(sampled)[None, None]

    def file_name(self, index: int) -> str:
        return ""

    def view(self, points: int = 60) -> SubmapView:
        """The submap: all frames are keyframes on their true poses, and see those points that are in their images."""
        generator = torch.Generator().manual_seed(1)
        width, height = CAMERA.size
        middle = len(self.T_cw) // 2
        pixels = torch.rand(points, 2, generator=generator, dtype=torch.float64) * torch.tensor(
            [width, height / 2]
        )
        points_w = self.points_w(middle, pixels + torch.tensor([0.0, height / 2 - 1]))
        submap = Submap.empty(0, CAMERA.params.double())
        ids = None
        for index, T_cw in enumerate(self.T_cw):
            frame = view_of(index, T_cw, points_w, generator)
            keyframe = submap.map.add_keyframe(frame, T_cw)
            covariances = 1e-4 * torch.eye(3, dtype=torch.float64).repeat(points, 1, 1)
            if ids is None:
                ids = submap.map.add_points(points_w, frame.descriptors, keyframe, covariances)
            in_front = transform(T_cw, points_w)[:, 2] > 0.1
            seen = torch.nonzero(in_front & CAMERA.in_image(frame.keypoints))[:, 0]
            submap.map.add_observations(keyframe, seen, ids[seen])
            submap.posed_frames.add(
                frame, estimate_at(T_cw, ids[seen], seen), torch.eye(4, dtype=torch.float64), keyframe
            )
        return SubmapView(submap, CAMERA.to(torch.float64), 0, self)
