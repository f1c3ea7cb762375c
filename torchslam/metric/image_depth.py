"""Depth of a pixel of a posed frame: the same small window in frames around it, along the ray of the pixel.

Every hypothesis of depth puts the window somewhere into the other images; the zero-mean normalized correlation measures
how alike they look there. One pixel costs some tenths of a second, a depth map seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.metric.source import SubmapView

CONTRAST = 2.0 / 255  # minimum standard deviation of the gray levels of a window; flatter ones count as noise
NEAREST = 30  # observed points nearest to the pixel, whose depths bound the search
NEARER, FARTHER = 0.5, 2.0
"""The search reaches from so much of the least of these depths to so much of the largest."""
PLANES = 128
"""Hypotheses over the range, equally far in inverse depth: a step is about a pixel for a parallax of ten degrees."""
REFINED = 65  # hypotheses of the second search, over `AGREEING` steps of the first to either side
BESIDE = (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)
"""Directions of the clicks beside that of the user; two and two are opposite."""
FRAMES = 12  # other frames that are compared at most, spread over those with a fitting parallax
ANGLES_DEG = (1.5, 15.0)
"""Parallax of these frames: less determines depth poorly, more makes the window look different."""
RADII = 4, 8, 12
"""Of the windows, in samples: a larger one where a smaller one finds nothing, or several places."""
SAMPLE_SHARE = 1 / 500  # distance of the samples of the window in widths of the image; at least a pixel
BEST_SHARE = 0.6  # share of the frames that must match; the others may not see the point
LEAST_FRAMES = 3  # frames without which there is no depth
LEAST_SCORE = 0.6  # correlation below which a search has failed
AGREEING = 3  # steps of the first search by which the best depth of a single frame may differ
AGREEING_SHARE = 0.4
"""Least share of the frames whose own best depth is there: repeated and weak texture has others elsewhere."""
RIVAL = 0.95  # a second maximum of so much of the correlation makes the depth ambiguous
MATCH_STD_PX = 0.3
"""Standard deviation of where a window matches in one image, pixels; noise and the slant of surfaces."""
CLICK_STD_PX = 1.0  # standard deviation of a click, pixels


def sample_windows(
    image: Float[np.ndarray, "H W"], pixels: Float[Tensor, "W P 2"]
) -> Float[np.ndarray, "W P"]:
    """Sample windows of P pixels, normalized to mean zero and unit length; flat ones are nearly zero.

    Beyond the image are the gray levels of its border.
    """
    x, y = pixels.numpy().astype(np.float32).transpose(2, 0, 1)
    window = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    window -= window.mean(axis=-1, keepdims=True)
    least = CONTRAST * math.sqrt(window.shape[-1])
    return np.asarray(window / np.maximum(np.linalg.norm(window, axis=-1, keepdims=True), least))


def correlate(
    own: Float[np.ndarray, "#W P"],
    points_o: Float[Tensor, "W P 3"],
    camera: Camera,
    image: Float[np.ndarray, "H W2"],
    border: float = 0.0,
) -> tuple[Float[np.ndarray, " W"], Bool[np.ndarray, " W"]]:
    """Correlate sampled windows with those of another image that shows their points, which are in its camera's frame.

    Returns the correlations, and whether all points of a window are in the image, `border` pixels from its edge.
    """
    pixels, seen = camera.project(points_o)
    inside = (seen & camera.in_image(pixels, border)).all(dim=-1).numpy()
    other = sample_windows(image, torch.where(seen[..., None], pixels, 0.0))
    return (own * other).sum(axis=-1), inside


@dataclass(frozen=True)
class LocatedPixel:
    """A pixel in the world; the covariance is that of the error of the depth and of the click."""

    point_w: Float[Tensor, " 3"]
    covariance_w: Float[Tensor, "3 3"]


def locate_pixel(view: SubmapView, frame_index: int, pixel: tuple[float, float]) -> LocatedPixel | str:
    """Find the point of the scene that a pixel (x, y) of a frame of the sequence shows; or say why it was not found."""
    row = torch.nonzero(view.frame_index == frame_index)[:, 0]
    where = f"{pixel[0]:g},{pixel[1]:g} of frame {frame_index}"
    if not len(row):
        return f"frame {frame_index} has no pose in this submap"
    T_cw, center = view.T_cw.detach().cpu().double(), int(row[0])
    depths = _depths_around(view, int(view.rows[center]), pixel)
    if not len(depths):
        return f"no map points are near {where}"
    sweep = _Sweep.of(view, T_cw, center, pixel, float(depths.median()))
    if sweep is None:
        return f"no other frames show {where} from a place {ANGLES_DEG[0]:g} degrees away"
    low, high = 1 / (FARTHER * float(depths.max())), 1 / (NEARER * float(depths.min()))
    found: tuple[float, float] | str = ""
    for radius in RADII:
        found = _search(replace(sweep, radius=radius), low, high, where)
        if not isinstance(found, str):
            break
    if isinstance(found, str):
        return found
    inverse_depth, std = found
    T_wc = se3_inverse(T_cw[center])
    along_c = _rays(sweep.camera, torch.tensor([pixel], dtype=torch.float64, device="cpu")) / inverse_depth
    point_w = transform(T_wc, along_c)[0]
    distance = float(along_c.norm())
    ray_w = (point_w - T_wc[:3, 3]) / distance
    outer = ray_w[:, None] * ray_w
    along, across = distance * std / inverse_depth, distance * CLICK_STD_PX / float(sweep.camera.focal)
    eye = torch.eye(3, dtype=outer.dtype, device="cpu")
    return LocatedPixel(point_w, along**2 * outer + across**2 * (eye - outer))


def _search(sweep: _Sweep, low: float, high: float, where: str) -> tuple[float, float] | str:
    """Find the inverse depth between two, and its standard deviation; or say why it was not found."""
    coarse = torch.linspace(low, high, PLANES, dtype=torch.float64, device="cpu")
    single = sweep.single_scores(np.zeros(2), coarse)
    scores = _joint(single)
    best = int(scores.argmax())
    if float(scores[best]) < LEAST_SCORE:
        return f"the window around {where} looks different in every other frame"
    padded = torch.nn.functional.pad(scores, (1, 1), value=-1.0)
    is_rival = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    is_rival &= (torch.arange(PLANES, device="cpu") - best).abs() > AGREEING
    if float(torch.where(is_rival, scores, -1.0).max()) > RIVAL * float(scores[best]):
        return f"the depth at {where} is ambiguous: click where the image has more texture"
    near = (single.argmax(dim=1) - best).abs() <= AGREEING
    if int(near.sum()) < max(LEAST_FRAMES, AGREEING_SHARE * len(single)):
        return f"the other frames disagree on the depth at {where}"
    start, end = coarse[max(best - AGREEING, 0)], coarse[min(best + AGREEING, PLANES - 1)]
    fine = torch.linspace(float(start), float(end), REFINED, dtype=torch.float64, device="cpu")
    single = sweep.single_scores(np.zeros(2), fine)
    inverse_depth = _maximum(fine, _joint(single))
    # The clicks that a hand with the error of a pixel makes as well see other depths, most of all at an edge.
    beside = [
        _maximum(fine, _joint(sweep.single_scores(CLICK_STD_PX * np.array(offset), fine)))
        for offset in BESIDE
    ]
    own = [_maximum(fine, scores) for scores in single[near]]
    # Poses that lie together have one error: the mean of many frames is not much better than that of a few.
    match = MATCH_STD_PX / sweep.pixels_per_inverse_depth(inverse_depth)
    single_std = math.hypot(match, float(np.std(np.array(own))))
    clicked = float(np.std(np.array([inverse_depth, *beside])))
    layers = _layer_std(sweep, coarse[::2], inverse_depth)
    return inverse_depth, math.hypot(clicked, layers, single_std / math.sqrt(LEAST_FRAMES))


def _layer_std(sweep: _Sweep, coarse: Float[Tensor, " D"], inverse_depth: float) -> float:
    """Standard deviation of an inverse depth by a second surface in the window.

    Two windows on opposite sides, with the pixel on their common border, see the mean of its inverse depth where the
    surface is a plane, however slanted. At the edge of an object they differ from that by half of the step between both
    surfaces, and the pixel lies on either one.
    """
    steps = [0.0]
    for one, other in zip(BESIDE[::2], BESIDE[1::2], strict=True):
        joint = [
            _joint(sweep.single_scores(sweep.radius * sweep.spacing * np.array(each), coarse))
            for each in (one, other)
        ]
        if min(float(scores.max()) for scores in joint) >= LEAST_SCORE:
            mean = sum(_maximum(coarse, scores) for scores in joint) / 2
            steps.append(2 * abs(mean - inverse_depth))
    return max(steps) / math.sqrt(2)


def _depths_around(view: SubmapView, frame_row: int, pixel: tuple[float, float]) -> Float[Tensor, " R"]:
    """Depths, in a posed frame, of the observed points that are nearest to a pixel."""
    frames, slam_map = view.submap.posed_frames, view.submap.map
    rows = torch.nonzero(frames.observations["frame_row"] == frame_row)[:, 0]
    points = slam_map.follow_merges(frames.observations["point_ids"][rows])
    pixels = frames.observations["pixels"][rows].cpu().double()
    nearest = (pixels - pixels.new_tensor(pixel)).norm(dim=-1).argsort()[:NEAREST]
    T_cw = frames.T_cw(slam_map)[frame_row]
    depths = transform(T_cw, slam_map.positions_w[points[nearest.to(points.device)]])[:, 2].cpu().double()
    return depths[depths > 0]


def _joint(single: Float[Tensor, "F D"]) -> Float[Tensor, " D"]:
    """Mean of the scores of the frames that match best."""
    count = min(max(LEAST_FRAMES, math.ceil(BEST_SHARE * len(single))), len(single))
    return single.topk(count, dim=0).values.mean(dim=0)


def _maximum(at: Float[Tensor, " N"], scores: Float[Tensor, " N"]) -> float:
    """Place of the maximum, by a parabola through the samples beside it."""
    best = int(scores[1:-1].argmax()) + 1
    left, middle, right = scores[best - 1 : best + 2].tolist()
    bend = left - 2 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float(at[best]) + max(-1.0, min(1.0, shift)) * float(at[1] - at[0])


@dataclass(frozen=True)
class _Sweep:
    """A window of a frame, and the other frames that are searched for it."""

    camera: Camera
    pixel: tuple[float, float]
    reference: Float[np.ndarray, "H W"]
    others: list[Float[np.ndarray, "H W"]]
    T_oc: Float[Tensor, "F 4 4"]
    radius: int = RADII[0]

    @classmethod
    def of(
        cls,
        view: SubmapView,
        T_cw: Float[Tensor, "K 4 4"],
        center: int,
        pixel: tuple[float, float],
        depth: float,
    ) -> _Sweep | None:
        """Read the images of the frame and, evenly over those with a fitting parallax, of others; None for too few."""
        camera, T_oc = view.camera.to("cpu"), T_cw @ se3_inverse(T_cw[center])
        point_c = depth * _rays(camera, torch.tensor([pixel], dtype=torch.float64, device="cpu"))
        pixels, seen = camera.project(transform(T_oc, point_c))
        border = RADII[0] * max(1.0, SAMPLE_SHARE * camera.width)
        seen = (seen & camera.in_image(pixels, border))[:, 0]
        toward = torch.nn.functional.normalize(point_c - se3_inverse(T_oc)[:, :3, 3], dim=-1)
        angles = torch.rad2deg(torch.acos((toward @ toward[center]).clamp(-1, 1)))
        rows = torch.nonzero(seen & (angles >= ANGLES_DEG[0]) & (angles <= ANGLES_DEG[1]))[:, 0]
        if len(rows) > FRAMES:
            places = torch.linspace(0, len(rows) - 1, FRAMES, dtype=torch.float64, device="cpu")
            rows = rows[places.round().long()]
        reference = view.gray(int(view.frame_index[center]))
        others = view.grays(rows.tolist())
        if reference is None or len(others) < LEAST_FRAMES:
            return None
        return cls(camera, pixel, reference, list(others.values()), T_oc[list(others)])

    @property
    def spacing(self) -> float:
        """Pixels from one sample of the window to the next."""
        return max(1.0, SAMPLE_SHARE * self.camera.width)

    def single_scores(
        self, offset: Float[np.ndarray, " 2"], inverse_depths: Float[Tensor, " D"]
    ) -> Float[Tensor, "F D"]:
        """Correlation, in each frame, of the window at the pixel and an offset; -1 where it is out of the image."""
        steps = self.spacing * np.arange(-self.radius, self.radius + 1)
        window = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + np.array(self.pixel) + offset
        own = sample_windows(self.reference, torch.from_numpy(window)[None])
        points_c = _rays(self.camera, torch.from_numpy(window)) / inverse_depths[:, None, None]  # (D, P, 3)
        scores = []
        for image, T_oc in zip(self.others, self.T_oc, strict=True):
            alike, inside = correlate(own, transform(T_oc, points_c), self.camera, image)
            scores.append(torch.from_numpy(np.where(inside, alike, -1.0)))
        return torch.stack(scores)

    def pixels_per_inverse_depth(self, inverse_depth: float) -> float:
        """How far the pixel moves in the other images with the inverse depth; the median."""
        step = 1e-4 * inverse_depth
        ray_c = _rays(self.camera, torch.tensor([self.pixel], dtype=torch.float64, device="cpu"))
        points_c = torch.cat([ray_c / (inverse_depth + sign * step) for sign in (-1, 1)])
        pixels, _ = self.camera.project(transform(self.T_oc, points_c))
        return float((pixels[:, 1] - pixels[:, 0]).norm(dim=-1).median()) / (2 * step)


def _rays(camera: Camera, pixels: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """Rays of pixels with z = 1."""
    rays = camera.unproject(pixels)
    return rays / rays[:, 2:]
