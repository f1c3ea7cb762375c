"""The height of a camera above the ground that it moves over, as a source of meters.

In each of some frames a plane below the camera is fitted to the images around it: small windows of the lower image are
put into other frames by the homography of the plane, and look there as they should. The plane is parallel to the path
of the camera, which keeps its height: a free pitch and the height have nearly the same effect on the images, and errors
of 5 to 10 %. What remains are the height and the roll.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.geometry.robust import median_with_error
from torchslam.metric.image_depth import correlate, sample_windows
from torchslam.metric.options import Given
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView, Unmeasured, parse_length

HEIGHTS = 0.01, 500.0  # meters: a toy, and a drone; above, the number is meant in millimeters
FRAMES = 16
"""Frames, evenly spread over a submap, in which a plane is sought: the error of one is 3 to 4 %."""
LEAST_FRAMES = 4
"""Frames with a plane without which there is no measurement."""
LEAST_BASELINE = 0.4
"""Distance from which on another frame is compared, in heights: nearer, the ground hardly moves in the image."""
PATH = 1.0
"""Distance, in heights, over which the direction of the path is taken to either side."""
MAX_BEND_DEG = 15.0
"""Largest angle of the path in a frame: in curves its direction is uncertain. On kitti07, 20 degrees did no harm."""
BELOW_HORIZON = 0.12
"""Least slope of the rays of a window, downward: beyond 8 heights the ground hardly moves in the image."""
ROWS, COLUMNS = 14, 28
"""Windows in the lower image."""
RADIUS_X, RADIUS_Y = 3, 2
"""Of a window, in samples: the ground is seen at a flat angle."""
SAMPLE_SHARE = 1 / 600
"""Distance of the samples of a window in widths of the image; at least a pixel."""
RANGE, STEPS = 2.0, 32
"""The search reaches from the guess by sparse points divided by RANGE to that times RANGE, in this number of steps."""
GUESS_QUANTILE = 0.85
"""Of the heights of the map points below the camera: most of them lie between the ground and the camera."""
ROUNDS = 4
"""Of the refinement, each with half the steps of the one before."""
ROLL_STEP = 0.02
"""First step of the roll, radians."""
MAX_ROLL = 0.08
"""Largest roll of a plane that is believed, radians: another surface has others."""
ALIKE, LEAST_SHARE = 0.7, 0.15
"""Correlation of a window that lies on the plane, and the least share of these windows."""
MODEL_STD = 0.015
"""Relative error that all frames share: the road is curved, the height is known to a centimeter or two, and the
focal length to 1 %."""


def from_options(given: Given) -> list[CameraHeight]:
    """The source of `--camera-height`."""
    return [CameraHeight(float(given["camera_height"][0][0]))]


@dataclass(frozen=True)
class CameraHeight:
    """A camera that moves over the ground at a known height, upright. Raises MeasurementError for an impossible one."""

    meters: float

    def __post_init__(self) -> None:
        parse_length(f"{self.meters:g}", f"--camera-height {self.meters}", *HEIGHTS)

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """Measure the unit of a submap by the median height over its frames."""
        if not view.has_images:
            return Unmeasured(ScaleSource.CAMERA_HEIGHT, "there are no images to find the ground in")
        heights = ground_heights(view)
        if len(heights) < LEAST_FRAMES:
            return Unmeasured(
                ScaleSource.CAMERA_HEIGHT,
                f"the ground is seen below the camera in {len(heights)} of {FRAMES} frames: it must move along it, and "
                "look at it",
            )
        middle, spread, error = median_with_error(np.log(heights))
        return ScaleMeasurement(
            ScaleSource.CAMERA_HEIGHT,
            self.meters / math.exp(middle),
            math.hypot(error, MODEL_STD),
            len(heights),
            "frames above the ground",
            apart=spread,
        )


def ground_heights(view: SubmapView) -> Float[np.ndarray, " R"]:
    """Heights of the camera above the ground in the frames in which the ground was detected, map units."""
    T_cw = view.T_cw.detach().cpu().double()
    centers_w = se3_inverse(T_cw)[:, :3, 3]
    windows = _Windows.of(view.camera.to("cpu"))
    places = torch.linspace(0, len(T_cw) - 1, FRAMES + 2, dtype=torch.float64, device="cpu")
    rows = places.round().long().unique().tolist()
    guess = _guess(view, T_cw[rows])
    if guess is None or windows is None:
        return np.empty(0)
    found = list[float]()
    for row in rows:
        around = _path(centers_w, row, guess)
        reference = None if around is None else view.gray(int(view.frame_index[row]))
        if around is None or reference is None:
            continue
        direction_w, beside = around
        if not (others := view.grays(beside)):
            continue
        fit = _PlaneFit(
            windows,
            sample_windows(reference, windows.pixels),
            list(others.values()),
            T_cw[list(others)] @ se3_inverse(T_cw[row]),
            T_cw[row, :3, :3] @ direction_w,
        )
        height = fit.height(guess)
        if height is not None:
            found.append(height)
    return np.array(found)


def _guess(view: SubmapView, T_cw: Float[Tensor, "R 4 4"]) -> float | None:
    """A guess of the height, by the map points below the camera in the images of some frames; None for too few."""
    camera, points_w = view.camera.to("cpu"), view.submap.map.positions_w[view.submap.map.valid_points()]
    points_c = transform(T_cw, points_w.detach().cpu().double())
    pixels, seen = camera.project(points_c)
    below = (points_c[..., 1] > BELOW_HORIZON * points_c[..., 2]) & seen & camera.in_image(pixels)
    heights = [
        float(points[near, 1].quantile(GUESS_QUANTILE))
        for points, near in zip(points_c, below, strict=True)
        if int(near.sum()) >= 5
    ]
    return float(np.median(heights)) if heights else None


def _path(
    centers_w: Float[Tensor, "K 3"], row: int, height: float
) -> tuple[Float[Tensor, " 3"], list[int]] | None:
    """The direction of the path around a frame, and rows to compare with; None where the path ends, or bends."""
    distances = (centers_w - centers_w[row]).norm(dim=-1)

    def nearest(rows: range, least: float) -> int | None:
        return next((each for each in rows if float(distances[each]) >= least * height), None)

    before, after = range(row - 1, -1, -1), range(row + 1, len(centers_w))
    ends = nearest(before, PATH), nearest(after, PATH)
    if ends[0] is None or ends[1] is None:
        return None
    parts = torch.stack((centers_w[row] - centers_w[ends[0]], centers_w[ends[1]] - centers_w[row]))
    back, forth = torch.nn.functional.normalize(parts, dim=-1)
    if float(back @ forth) < math.cos(math.radians(MAX_BEND_DEG)):
        return None
    others = nearest(before, LEAST_BASELINE), nearest(after, LEAST_BASELINE)
    along = centers_w[ends[1]] - centers_w[ends[0]]
    return along / along.norm(), [each for each in others if each is not None]


@dataclass(frozen=True)
class _Windows:
    """Windows in the lower image: pixels, and their rays with z = 1."""

    camera: Camera
    pixels: Float[Tensor, "W P 2"]
    rays: Float[Tensor, "W P 3"]

    @classmethod
    def of(cls, camera: Camera) -> _Windows | None:
        """The windows of a camera; None where it does not look at the ground at all."""
        spacing = max(1.0, SAMPLE_SHARE * camera.width)
        margin = 2 + spacing * max(RADIUS_X, RADIUS_Y)
        fy, cy = float(camera.params[1]), float(camera.params[3])
        top, bottom = max(cy + BELOW_HORIZON * fy, margin), camera.height - 1 - margin
        if top >= bottom:
            return None
        columns = np.linspace(margin, camera.width - 1 - margin, COLUMNS), np.linspace(top, bottom, ROWS)
        samples = np.arange(-RADIUS_X, RADIUS_X + 1), np.arange(-RADIUS_Y, RADIUS_Y + 1)
        centers, offsets = (np.stack(np.meshgrid(*xy), axis=-1).reshape(-1, 2) for xy in (columns, samples))
        pixels = torch.from_numpy(centers[:, None] + spacing * offsets)
        rays = camera.unproject(pixels)
        return cls(camera, pixels, rays / rays[..., 2:])


@dataclass(frozen=True)
class _PlaneFit:
    """The windows of a frame, and the other frames in which a plane puts them somewhere."""

    windows: _Windows
    own: Float[np.ndarray, "W P"]
    others: list[Float[np.ndarray, "H W"]]
    T_oc: Float[Tensor, "F 4 4"]
    direction_c: Float[Tensor, " 3"]

    def height(self, guess: float) -> float | None:
        """The height of the camera above the plane that fits best; None where none fits."""
        heights = guess * np.exp(np.linspace(-math.log(RANGE), math.log(RANGE), STEPS))
        rough = replace(self, others=self.others[:1], T_oc=self.T_oc[:1])
        quality = [rough.quality(height, 0.0) for height in heights]
        best = int(np.argmax(quality))
        if best in (0, STEPS - 1):
            return None
        at = np.array((math.log(heights[best]), 0.0))
        steps = np.array((math.log(heights[1] / heights[0]), ROLL_STEP))
        for _ in range(ROUNDS):
            for axis in (0, 1):
                places = [at + shift * steps * (np.arange(2) == axis) for shift in (-1, 0, 1)]
                left, middle, right = (self.quality(math.exp(height), roll) for height, roll in places)
                bend = left - 2 * middle + right
                shift = 0.5 * (left - right) / bend if bend < 0 else float(np.sign(right - left))
                at[axis] += steps[axis] * max(-1.0, min(1.0, shift))
            steps /= 2
        share = float((self.scores(math.exp(at[0]), at[1]) > ALIKE).mean())
        if share < LEAST_SHARE or abs(at[1]) > MAX_ROLL:
            return None
        return math.exp(at[0])

    def quality(self, height: float, roll: float) -> float:
        """Sum of the squared correlations of the windows with a plane: those that do not lie on it count little."""
        return float(np.square(self.scores(height, roll).clip(0)).sum())

    def scores(self, height: float, roll: float) -> Float[np.ndarray, " W"]:
        """Mean correlation of each window with where the plane puts it, over the frames that show that, or 0."""
        down_c = torch.tensor((math.sin(roll), math.cos(roll), 0.0), dtype=torch.float64, device="cpu")
        normal_c = down_c - (down_c @ self.direction_c) * self.direction_c
        inverse_depths = self.windows.rays @ (normal_c / normal_c.norm()) / height
        points_c = self.windows.rays / inverse_depths.clamp(min=1e-9)[..., None]
        total, count = np.zeros(len(self.own)), np.zeros(len(self.own))
        for image, T_oc in zip(self.others, self.T_oc, strict=True):
            alike, inside = correlate(self.own, transform(T_oc, points_c), self.windows.camera, image, 1.0)
            total += np.where(inside, alike, 0.0)
            count += inside
        return total / np.maximum(count, 1)
