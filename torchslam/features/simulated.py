"""Simulated features: 3-D points projected through the true poses. They prove the geometry apart from the images."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.values import Features

DESCRIPTOR_BYTES = 32


class SimulatedFeatures:
    """Keypoints of a made-up scene: every point has its own random descriptor, seen alike from everywhere.

    Points are scattered in the views of the true trajectory, at depths between `depth_near` and `depth_far` times
    the extent of the trajectory (the largest distance of a camera from their mean; 1 m where the camera rests).

    T_cw:       (F, 4, 4) true poses
    noise_px:   standard deviation of the keypoints
    outliers:   share of the keypoints that lie at a uniformly random place of the image
    dropout:    share of the visible points that a frame misses
    Each frame draws from a generator seeded by (seed, frame), so frames can be asked for in any order. The scene lies
    on the CPU, whose generator draws the same everywhere; features go where the frame's pose is.
    """

    def __init__(
        self,
        T_cw: Tensor,
        camera: Camera,
        *,
        num_keypoints: int = 1000,
        points_per_view: int = 400,
        depth_near: float = 0.1,
        depth_far: float = 1.0,
        noise_px: float = 0.0,
        outliers: float = 0.0,
        dropout: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.camera, T_cw = camera.to("cpu"), T_cw.cpu()
        self.num_keypoints = num_keypoints
        self.noise_px, self.outliers, self.dropout, self.seed = noise_px, outliers, dropout, seed
        T_wc = se3_inverse(T_cw)
        centres = T_wc[:, :3, 3]
        extent = float(torch.linalg.vector_norm(centres - centres.mean(0), dim=-1).max()) or 1.0
        self.depth_range = (depth_near * extent, depth_far * extent)
        generator = torch.Generator().manual_seed(seed)
        self.points_w = self._scatter(T_wc, points_per_view, generator)
        # Where more are visible than a frame may have keypoints, the same ones win in every frame.
        self.strengths = torch.rand(len(self.points_w), generator=generator)
        self.descriptors = torch.randint(
            0, 256, (len(self.points_w), DESCRIPTOR_BYTES), generator=generator, dtype=torch.uint8
        )

    def _scatter(self, T_wc: Tensor, per_view: int, generator: torch.Generator) -> Tensor:
        """(P, 3) points such that every view holds about `per_view`: views are filled up in the order of the frames."""
        width, height = self.camera.size
        near, far = self.depth_range
        points_w = T_wc.new_zeros(0, 3)
        for pose in T_wc:
            visible = self._visible(se3_inverse(pose), points_w)[1].sum() if len(points_w) else 0
            missing = per_view - int(visible)
            if missing <= 0:
                continue
            pixels = torch.rand(missing, 2, generator=generator, dtype=pose.dtype) * pose.new_tensor(
                [width - 1, height - 1]
            )
            depth = near * (far / near) ** torch.rand(missing, 1, generator=generator, dtype=pose.dtype)
            rays = self.camera.unproject(pixels)
            points_w = torch.cat([points_w, transform(pose, rays / rays[:, 2:] * depth)])
        return points_w

    def _visible(self, T_cw: Tensor, points_w: Tensor) -> tuple[Tensor, Tensor]:
        points_c = transform(T_cw, points_w)
        pixels, valid = self.camera.project(points_c)
        # Far points stay visible for a while after the trajectory has moved on; very near ones do not.
        near, far = self.depth_range
        depth = points_c[:, 2]
        return pixels, valid & self.camera.in_image(pixels) & (depth > 0.5 * near) & (depth < 2 * far)

    def __call__(self, T_cw: Tensor, frame_index: int) -> Features:
        """Features (batch of one) of the frame with this true pose (4, 4)."""
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + frame_index) % 2**63)
        device, T_cw = T_cw.device, T_cw.cpu()
        width, height = self.camera.size
        pixels, visible = self._visible(T_cw, self.points_w)
        ids = torch.nonzero(visible)[:, 0]
        ids = ids[torch.rand(len(ids), generator=generator) >= self.dropout]
        strongest = torch.argsort(self.strengths[ids], descending=True)[: self.num_keypoints]
        ids = ids[strongest[torch.randperm(len(strongest), generator=generator)]]
        keypoints = pixels[ids] + self.noise_px * torch.randn(
            len(ids), 2, generator=generator, dtype=pixels.dtype
        )
        anywhere = torch.rand(len(ids), 2, generator=generator, dtype=pixels.dtype)
        is_outlier = torch.rand(len(ids), 1, generator=generator) < self.outliers
        keypoints = torch.where(is_outlier, anywhere * pixels.new_tensor([width - 1, height - 1]), keypoints)
        return self._padded(keypoints, self.descriptors[ids]).to(device)

    def _padded(self, keypoints: Tensor, descriptors: Tensor) -> Features:
        n, N = len(keypoints), self.num_keypoints
        mask = torch.arange(N) < n
        ones = torch.ones(1, N, dtype=keypoints.dtype)
        return Features(
            torch.cat([keypoints, keypoints.new_zeros(N - n, 2)])[None],
            ones,
            ones,
            torch.zeros_like(ones),
            torch.cat([descriptors, descriptors.new_zeros(N - n, DESCRIPTOR_BYTES)])[None],
            mask[None],
        )
