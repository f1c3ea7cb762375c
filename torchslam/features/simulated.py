"""Simulated features: 3-D points projected through the true poses, to test the geometry without images."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.features.contract import BINARY_BYTES
from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.geometry.precision import without_autocast
from torchslam.types import Features

LEVELS, FACTOR = 8, 1.2  # the pyramid of the scales, as that of ORB


class SimulatedFeatures:
    """Keypoints of a synthetic scene: every point has its own random descriptor, the same from everywhere.

    Points are scattered in the views of the true trajectory, at depths between `depth_near` and `depth_far` times
    the extent of the trajectory (the largest distance of a camera from their mean; 1 m if the camera rests). Each
    frame draws from a generator seeded by (seed, frame), so frames can be requested in any order. The scene is on
    the CPU, whose generator draws the same everywhere; features are on the device of the frame's pose.

    Args:
        T_cw: true poses.
        camera: of all frames.
        num_keypoints: number of rows of the features; the strongest points are used.
        points_per_view: number of points to place in each view.
        depth_near: smallest depth, in units of the extent.
        depth_far: largest depth, in units of the extent.
        noise_px: standard deviation of the keypoints.
        outliers: fraction of the keypoints that are at a uniformly random place of the image.
        dropout: fraction of the visible points that a frame misses.
        scales: whether points have a size and a direction. Then a keypoint has the scale at which its point appears
            from that depth, in steps of the pyramid's factor, and is visible only at scales of the pyramid; its noise
            grows with its scale, and its angle turns with the camera. Without it all scales are one.
        seed: of all random numbers.
    """

    @without_autocast
    def __init__(
        self,
        T_cw: Float[Tensor, "K 4 4"],
        camera: Camera,
        *,
        num_keypoints: int = 1000,
        points_per_view: int = 400,
        depth_near: float = 0.1,
        depth_far: float = 1.0,
        noise_px: float = 0.0,
        outliers: float = 0.0,
        dropout: float = 0.0,
        scales: bool = False,
        seed: int = 0,
    ) -> None:
        self.camera, T_cw = camera.to("cpu"), T_cw.cpu()
        self.num_keypoints, self.scales = num_keypoints, scales
        self.noise_px, self.outliers, self.dropout, self.seed = noise_px, outliers, dropout, seed
        T_wc = se3_inverse(T_cw)
        centers = T_wc[:, :3, 3]
        extent = float(torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max()) or 1.0
        self.depth_range = (depth_near * extent, depth_far * extent)
        generator = torch.Generator().manual_seed(seed)
        self.sizes = T_cw.new_zeros(0)  # (P,) meters
        self.directions_w = T_cw.new_zeros(0, 3)  # (P, 3) unit vectors along their texture
        self.points_w = T_cw.new_zeros(0, 3)
        self._scatter(T_wc, points_per_view, generator)
        # Where more are visible than a frame may have keypoints, the same ones win in every frame.
        self.strengths = torch.rand(
            len(self.points_w), generator=generator, dtype=torch.float32, device="cpu"
        )
        self.descriptors = torch.randint(
            0, 256, (len(self.points_w), BINARY_BYTES), generator=generator, dtype=torch.uint8, device="cpu"
        )

    def _scatter(self, T_wc: Tensor, per_view: int, generator: torch.Generator) -> None:
        """Add points so that every view has about `per_view`, in the order of the frames."""
        width, height = self.camera.size
        near, far = self.depth_range
        for pose in T_wc:
            missing = per_view - int(self._visible(se3_inverse(pose))[1].sum())
            if missing <= 0:
                continue
            drawn = (
                torch.rand(missing, n, generator=generator, dtype=pose.dtype, device="cpu") for n in (2, 1)
            )
            pixels = next(drawn) * pose.new_tensor([width - 1, height - 1])
            depth = near * (far / near) ** next(drawn)
            rays = self.camera.unproject(pixels)
            self.points_w = torch.cat([self.points_w, transform(pose, rays / rays[:, 2:] * depth)])
            if self.scales:
                self._shape(pose, depth[:, 0], generator)

    def _shape(
        self, T_wc: Float[Tensor, "4 4"], depth: Float[Tensor, " N"], generator: torch.Generator
    ) -> None:
        """Give new points at these depths in the view T_wc sizes, of any level, and directions in its image."""
        draw = torch.rand(2, len(depth), generator=generator, dtype=depth.dtype, device="cpu")
        sizes = FACTOR ** ((LEVELS - 1) * draw[0]) * depth / self.camera.focal
        angle = 2 * torch.pi * draw[1]
        directions_c = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
        self.sizes = torch.cat([self.sizes, sizes])
        self.directions_w = torch.cat([self.directions_w, directions_c @ T_wc[:3, :3].mT])

    def _visible(
        self, T_cw: Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "N 2"], Bool[Tensor, " N"], Float[Tensor, " N"], Float[Tensor, " N"]]:
        """Pixels of all points, whether each is visible, its level in the pyramid, and its angle."""
        points_c = transform(T_cw, self.points_w)
        pixels, valid = self.camera.project(points_c)
        # Far points stay visible for a while after the trajectory has moved on; very near ones do not.
        near, far = self.depth_range
        depth = points_c[:, 2]
        visible = valid & self.camera.in_image(pixels) & (depth > 0.5 * near) & (depth < 2 * far)
        if not self.scales:
            return pixels, visible, torch.zeros_like(depth), torch.zeros_like(depth)
        appears = self.sizes * self.camera.focal / depth.clamp(min=0.1 * near)
        level = (appears.log() / math.log(FACTOR)).round()
        # How the image of a point moves when the point moves along its direction.
        along = self.directions_w @ T_cw[:3, :3].mT
        image = depth[:, None] * along[:, :2] - along[:, 2:] * points_c[:, :2]
        angle = torch.atan2(image[:, 1], image[:, 0])
        return pixels, visible & (level >= 0) & (level < LEVELS), level, angle

    @without_autocast
    def __call__(self, T_cw: Float[Tensor, "4 4"], frame_index: int) -> Features:
        """Return the features (a batch of one) of the frame with this true pose."""
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + frame_index) % 2**63)
        device, T_cw = T_cw.device, T_cw.cpu()
        width, height = self.camera.size
        pixels, visible, level, angle = self._visible(T_cw)
        ids = torch.nonzero(visible)[:, 0]
        ids = ids[
            torch.rand(len(ids), generator=generator, dtype=torch.float32, device="cpu") >= self.dropout
        ]
        strongest = torch.argsort(self.strengths[ids], descending=True)[: self.num_keypoints]
        ids = ids[strongest[torch.randperm(len(strongest), generator=generator, device="cpu")]]
        scales = FACTOR ** level[ids]
        noise = torch.randn(len(ids), 2, generator=generator, dtype=pixels.dtype, device="cpu")
        keypoints = pixels[ids] + self.noise_px * scales[:, None] * noise
        anywhere = torch.rand(len(ids), 2, generator=generator, dtype=pixels.dtype, device="cpu")
        is_outlier = (
            torch.rand(len(ids), 1, generator=generator, dtype=torch.float32, device="cpu") < self.outliers
        )
        keypoints = torch.where(is_outlier, anywhere * pixels.new_tensor([width - 1, height - 1]), keypoints)
        missing = self.num_keypoints - len(ids)

        def padded(rows: Tensor, value: float = 0.0) -> Tensor:
            return F.pad(rows, (0, 0) * (rows.ndim - 1) + (0, missing), value=value)[None]

        mask = torch.arange(self.num_keypoints, device="cpu") < len(ids)
        return Features(
            padded(keypoints),
            keypoints.new_ones(1, self.num_keypoints),
            padded(scales, 1.0),
            padded(angle[ids]),
            padded(self.descriptors[ids]),
            mask[None],
        ).to(device)
