"""True depth of views in map units: of a depth sensor beside the camera, or of a rendered scene."""

from __future__ import annotations

from collections.abc import Sequence as Frames
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.data.synthetic.renderer import Renderer
from torchslam.data.synthetic.sequence import FOCAL, SCENES, SIZE, SyntheticSequence
from torchslam.geometry import Camera, se3_exp, se3_inverse, transform

EVERY = 10  # frames from one sensor image to the next
SENSOR_FOCAL = 585.0
RANGE_M = (0.3, 8.0)  # of the sensor
FRONT = 1.03  # relative depth up to which points in a pixel belong to its nearest surface
STEPS = 300
SAMPLE = 17  # every so many pixels are used to register


class Sensor:
    """Depth images of a second camera that is fixed to the first one.

    Args:
        folder: `depth/` of the sequence.
        frames, T_cw: posed frames of the run.
    """

    def __init__(self, folder: Path, frames: Int[Tensor, " F"], T_cw: Float[Tensor, "F 4 4"]) -> None:
        self._folder = folder
        self._T_cw = dict(zip(frames.tolist(), T_cw.double(), strict=True))
        self._last = max(int(path.stem) for path in folder.glob("*.png"))

    def register(
        self,
        frames: Frames[int],
        depth: Float[Tensor, "K H W"],
        T_cw: Float[Tensor, "K 4 4"],
        camera: Camera,
        sample: int = SAMPLE,
    ) -> tuple[Float[Tensor, "4 4"], float]:
        """Find the pose of the sensor and the length of a map unit from estimated depth, by a robust fit.

        Args:
            frames, depth, T_cw, camera: estimated depth, 0 where it is not known.
            sample: every so many known pixels are used.

        Returns:
            T_cs, sensor to camera, in meters, and meters per map unit: one of each for all frames.
        """
        points, images = [], []
        rays = camera.normalize(_pixels(*camera.size))
        for index, z, pose in zip(frames, depth.double(), T_cw, strict=True):
            kept = torch.nonzero(z.flatten() > 0)[::sample, 0]
            points_c = F.pad(rays[kept], (0, 1), value=1.0) * z.flatten()[kept, None]
            points.append(transform(self._near(index)[1] @ se3_inverse(pose), points_c))
            images.append(self._image(self._near(index)[0]))
        pose = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        scale = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
        with torch.no_grad():  # the first scale makes the median right
            ratios = torch.cat([self._ratios(p, i) for p, i in zip(points, images, strict=True)])
            scale -= ratios.median().log()
        optimizer = torch.optim.Adam([pose, scale], lr=2e-3)
        for step in range(STEPS):
            optimizer.param_groups[0]["lr"] = 2e-3 if step < STEPS / 2 else 4e-4
            T_sc = se3_exp(pose)
            errors = torch.cat(
                [
                    self._ratios(transform(T_sc, p * scale.exp()), i).log().abs()
                    for p, i in zip(points, images, strict=True)
                ]
            )
            loss = (errors / (0.03 + errors)).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return se3_inverse(se3_exp(pose.detach())), float(scale.detach().exp())

    def depth(
        self,
        index: int,
        T_cw: Float[Tensor, "4 4"],
        camera: Camera,
        T_cs: Float[Tensor, "4 4"],
        meters: float,
    ) -> Float[Tensor, "H W"]:
        """Depth of a view from the sensor image nearest in time, map units; 0 where unknown."""
        near, T_near = self._near(index)
        z = self._image(near).flatten()
        kept = torch.nonzero(z > 0)[:, 0]
        pixels = _pixels(640, 480)[kept]
        xy = (pixels - torch.tensor((320.0, 240.0))) / SENSOR_FOCAL
        points = transform(T_cs, F.pad(xy, (0, 1), value=1.0) * z[kept, None]) / meters
        points = transform(T_cw.double() @ se3_inverse(T_near), points)
        projected, valid = camera.project(points)
        place = projected.round().long()
        width, height = camera.size
        valid = valid & (place >= 0).all(1) & (place[:, 0] < width) & (place[:, 1] < height)
        cell, depth = (place[:, 1] * width + place[:, 0])[valid], points[valid, 2]
        nearest = torch.full((width * height,), torch.inf, dtype=depth.dtype).scatter_reduce(
            0, cell, depth, "amin"
        )
        is_front = depth < FRONT * nearest[cell]
        total = torch.zeros(width * height, dtype=depth.dtype).index_add(0, cell[is_front], depth[is_front])
        count = torch.bincount(cell[is_front], minlength=width * height)
        return (total / count.clamp(min=1)).reshape(height, width)

    def _near(self, index: int) -> tuple[int, Tensor]:
        frame = min(self._last, round(index / EVERY) * EVERY)
        return frame, self._T_cw[frame]

    def _image(self, frame: int) -> Tensor:
        image = cv2.imread(str(self._folder / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert image is not None, frame
        depth = torch.from_numpy(image.astype(np.float64)) / 1000
        return torch.where((depth > RANGE_M[0]) & (depth < RANGE_M[1]), depth, 0.0)

    def _ratios(self, points_s: Tensor, image: Tensor) -> Tensor:
        """Depth of points over that of the sensor, where it has all four pixels."""
        at = points_s[:, :2] / points_s[:, 2:] * SENSOR_FOCAL + torch.tensor((320.0, 240.0))
        grid = (at / torch.tensor((639.0, 479.0)) * 2 - 1)[None, None]
        both = torch.stack((image, (image > 0).to(image)))[None]
        seen, share = F.grid_sample(both, grid, align_corners=True)[0, :, 0]
        kept = (share > 0.999) & (points_s[:, 2] > 0)
        return (points_s[:, 2] / seen.clamp(min=RANGE_M[0]))[kept].clamp(0.1, 10)


def rendered_depth(
    sequence: SyntheticSequence, frames: Frames[int], size: tuple[int, int], meters: float
) -> Float[Tensor, "K H W"]:
    """Exact depth of a rendered sequence at another size, in map units of so many meters."""
    K = np.array(((FOCAL, 0, (SIZE[0] - 1) / 2), (0, FOCAL, (SIZE[1] - 1) / 2), (0, 0, 1)))
    renderer = Renderer(SCENES[sequence.name].build(sequence._options.seed), K, SIZE)
    y, x = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float64)
    x, y = (x + 0.5) * SIZE[0] / size[0] - 0.5, (y + 0.5) * SIZE[1] / size[1] - 0.5
    depths = []
    for index in frames:
        pose = sequence.pose(index)
        assert pose is not None
        best = np.zeros(size[::-1])
        for form, (width, height) in zip(
            renderer._linear_forms(pose[None].numpy())[0], renderer._sizes, strict=True
        ):
            u, v, q = (a * x + b * y + c for a, b, c in form)
            hit = (q > best) & (u >= 0) & (v >= 0) & (u <= width * q) & (v <= height * q)
            best = np.where(hit, q, best)
        depths.append(torch.from_numpy(np.where(best > 0, 1 / np.where(best > 0, best, 1.0), 0.0) / meters))
    return torch.stack(depths).float()


def _pixels(width: int, height: int) -> Float[Tensor, "N 2"]:
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return torch.stack((x, y), dim=-1).flatten(0, 1)
