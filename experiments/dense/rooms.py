"""Random rendered rooms with exact depth, to train on: walls without texture, thin things, reflections, noisy poses.

A room is a box with 8 to 21 boxes in it, of `torchslam.data.synthetic`. Two in five surfaces are nearly plain. A sample
is an image with 3 to 8 others around it or, in three of five, on one side of it, as at the end of a recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.synthetic.renderer import Renderer
from torchslam.data.synthetic.scene import Painter, Rectangle
from torchslam.geometry import Camera, rigid, se3_exp, se3_inverse, so3_exp, transform

SIZE = (320, 240)
TEXEL = 0.008  # meters
PLAIN = 0.4  # share of the boxes with little contrast
ONE_SIDED = 0.6
PARALLAX = 0.085  # baseline over depth, median
LEAST_RANGE, MOST_RANGE = 1.5, 14.0  # far over near: a single wall teaches little
NEAREST = 0.25  # meters
POSE_NOISE = (0.0015, 0.0007)  # of the depth, and radians, times 0 to 1.5
TRIES = 60


class Sample(NamedTuple):
    """An image with others around it, and its exact depth; meters."""

    reference: Float[Tensor, "H W"]
    sources: Float[Tensor, "V H W"]
    camera: Camera
    T_sr: Float[Tensor, "V 4 4"]
    near: Float[Tensor, ""]
    far: Float[Tensor, ""]
    depth: Float[Tensor, "H W"]


def samples(seed: int, count: int) -> Iterator[Sample]:
    """Samples of the room of a seed, at most `count`."""
    rng = np.random.default_rng(seed)
    rectangles, extent = _room(rng)
    focal = float(rng.uniform(230, 300))
    center = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    camera = Camera.pinhole(focal, focal, *center, size=SIZE)
    renderer = Renderer(rectangles, camera.K.numpy(), SIZE)
    found = 0
    for _ in range(TRIES):
        position = rng.uniform(-0.42, 0.42, 3) * extent
        position[1] = rng.uniform(-0.25, 0.2) * extent[1]
        R_wc = _rotation(rng.uniform(-3.14, 3.14), rng.normal(0, 0.2), rng.normal(0, 0.08))
        T_wc = rigid(R_wc, torch.from_numpy(position))
        depth = exact_depth(renderer, T_wc)
        near, median, far = np.quantile(depth, (0.02, 0.5, 0.98))
        if near < NEAREST or not LEAST_RANGE < far / near < MOST_RANGE or (depth == 0).mean() > 0.02:
            continue
        T_wcs = torch.cat((T_wc[None], _around(rng, T_wc, median)))
        images = _images(rng, renderer, camera, se3_inverse(T_wcs), depth)
        noise = rng.normal(size=(len(T_wcs) - 1, 6)) * np.repeat((POSE_NOISE[0] * median, POSE_NOISE[1]), 3)
        T_sr = se3_exp(torch.from_numpy(noise * rng.uniform(0, 1.5))) @ se3_inverse(T_wcs[1:]) @ T_wc
        nearest = torch.tensor(near * 0.75 * rng.uniform(0.85, 1.1))
        farthest = torch.tensor(far * 1.35 * rng.uniform(0.9, 1.25))
        exact = torch.from_numpy(depth).float()
        yield Sample(images[0], images[1:], camera, T_sr, nearest, farthest, exact)
        found += 1
        if found == count:
            return


def exact_depth(renderer: Renderer, T_wc: Float[Tensor, "4 4"]) -> np.ndarray:
    """Depth of the pixels, meters; 0 where nothing is seen."""
    width, height = renderer._size
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    best = np.zeros((height, width))
    for form, (along_u, along_v) in zip(
        renderer._linear_forms(se3_inverse(T_wc)[None].numpy())[0], renderer._sizes, strict=True
    ):
        u, v, q = (a * x + b * y + c for a, b, c in form)
        is_hit = (q > best) & (u >= 0) & (v >= 0) & (u <= along_u * q) & (v <= along_v * q)
        best = np.where(is_hit, q, best)
    return np.where(best > 0, 1 / np.where(best > 0, best, 1.0), 0.0)


def _room(rng: np.random.Generator) -> tuple[list[Rectangle], np.ndarray]:
    """Rectangles, and the extent of the room."""
    extent = np.array((rng.uniform(3.5, 9), rng.uniform(2.4, 3.4), rng.uniform(3.5, 9)))
    rectangles = _box(rng, np.zeros(3), extent, 0.0)
    for _ in range(rng.integers(8, 22)):
        kind = rng.random()
        if kind < 0.2:  # a pole
            size = np.array((rng.uniform(0.03, 0.12), rng.uniform(0.4, 2.2), rng.uniform(0.03, 0.12)))
        elif kind < 0.35:  # a board
            size = np.array((rng.uniform(0.4, 1.6), rng.uniform(0.03, 0.1), rng.uniform(0.4, 1.0)))
        else:
            size = rng.uniform(0.15, 1.2, 3) * (1, rng.uniform(0.5, 1.8), 1)
        center = rng.uniform(-0.5, 0.5, 3) * extent * 0.95
        if rng.random() < 0.7:  # on the floor, or on something
            center[1] = (extent[1] - size[1]) / 2 - (rng.uniform(0, 0.9) if rng.random() < 0.4 else 0)
        rectangles += _box(rng, center, size, float(rng.uniform(0, 2 * math.pi)))
    return rectangles, extent


def _box(rng: np.random.Generator, center: np.ndarray, size: np.ndarray, turn: float) -> list[Rectangle]:
    """A box whose sides have little contrast or much, each."""
    coverage = float(rng.choice((0.0, 0.03, 0.1, 0.25), p=(0.2, 0.25, 0.25, 0.3)))
    x, y, z = center.tolist()
    a, b, c = size.tolist()
    sides = []
    for side in Painter(rng, TEXEL, coverage).box((x, y, z), (a, b, c), turn):
        contrast = rng.uniform(0.02, 0.25) if rng.random() < PLAIN else rng.uniform(0.3, 1)
        mean = side.texture.mean()
        tone = mean if rng.random() < 0.5 else rng.uniform(30, 220)
        texture = tone + contrast * (side.texture.astype(np.float32) - mean)
        sides.append(replace(side, texture=texture.clip(0, 255).astype(np.uint8)))
    return sides


def _around(rng: np.random.Generator, T_wc: Tensor, depth: float) -> Float[Tensor, "V 4 4"]:
    """T_wc of cameras beside one."""
    parallax = PARALLAX * math.exp(rng.normal(0, 0.45))
    is_one_sided = rng.random() < ONE_SIDED
    along = _unit(rng.normal(size=3) * (1, 0.5, 0.5))
    poses = []
    for _ in range(8 if rng.random() < 0.85 else int(rng.integers(3, 8))):
        side = 1.6 if is_one_sided else rng.choice((-1, 1))
        direction = _unit(side * along + 0.5 * rng.normal(size=3) * (1, 0.6, 0.6))
        moved = direction * depth * parallax * rng.uniform(0.4, 1.6)
        # Towards what the first camera sees; from one side also away from it.
        share = rng.uniform(-0.8, 0.3) if is_one_sided else rng.uniform(-0.2, 1.2)
        yaw = -moved[0] / depth * share + rng.normal(0, 0.03)
        pitch = moved[1] / depth * rng.uniform(-0.2, 1.2) + rng.normal(0, 0.03)
        turn = _rotation(yaw, pitch, rng.normal(0, 0.03))
        poses.append(T_wc @ rigid(turn, torch.from_numpy(moved)))
    return torch.stack(poses)


def _images(
    rng: np.random.Generator, renderer: Renderer, camera: Camera, T_cw: Tensor, depth: np.ndarray
) -> Float[Tensor, "V H W"]:
    """Images with noise, blur, changes of exposure and reflections, in [0, 1]; depth is that of the first one."""
    noise, blur, exposure = rng.uniform(0.3, 5), rng.uniform(0.25, 1.1), rng.uniform(0, 0.12)
    gamma, gain = rng.uniform(0.7, 1.3), rng.uniform(0.5, 1.1)
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(np.float32)
    lights = []
    for _ in range(int(rng.integers(0, 5)) if rng.random() < 0.6 else 0):
        row, column = rng.integers(0, SIZE[1]), rng.integers(0, SIZE[0])
        # A reflected light is seen as far away as the light, behind the surface.
        ray = camera.normalize(torch.tensor([[float(column), float(row)]]).double())[0]
        light_c = torch.cat((ray, torch.ones(1).double())) * depth[row, column] * rng.uniform(1.3, 3)
        lights.append(
            (transform(se3_inverse(T_cw[0]), light_c[None]), rng.uniform(4, 30), rng.uniform(15, 120))
        )
    images = []
    for view, T in enumerate(T_cw):
        image = renderer.render(T.numpy())
        for light_w, spread, amount in lights:
            (at,), is_seen = camera.project(transform(T, light_w))
            if bool(is_seen):
                square = (x - float(at[0])) ** 2 + (y - float(at[1])) ** 2
                image = image + amount * np.exp(-0.5 * square / spread**2)
        image = 255 * np.clip(image * gain / 255, 0, 1) ** gamma
        width = blur if view == 0 else blur * rng.uniform(0.8, 1.3)
        image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), width)
        image = image * (1 + rng.normal(0, exposure)) + noise * rng.standard_normal(image.shape)
        images.append(torch.from_numpy(image.round().clip(0, 255)).float() / 255)
    return torch.stack(images)


def _rotation(yaw: float, pitch: float, roll: float) -> Float[Tensor, "3 3"]:
    y, x, z = so3_exp(torch.tensor(((0, yaw, 0), (pitch, 0, 0), (0, 0, roll)), dtype=torch.float64))
    return y @ x @ z


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
