"""Rendered sequences: the scenes, random paths of a camera as functions of time, and their images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data import Sequence
from torchslam.data.formats.image_file import gray_to_tensor
from torchslam.data.sequence import Transformed, unzoomed_image
from torchslam.data.synthetic.renderer import Renderer
from torchslam.data.synthetic.scene import Painter, Rectangle, room, wall
from torchslam.data.synthetic.sequence import poses
from torchslam.geometry import Camera, se3_inverse
from torchslam.types import Trajectory

FRAME_RATE = 30.0
"""Frames per second."""
STREET = (2.4, 1.6, 12.0)
"""Width, height and length of the street, meters: a street at about a quarter of its size, to save texture."""
HOUSES_EVERY = 1.1
"""Meters along the street from one pair of boxes at its sides to the next one."""
WARP_STEPS = 50
"""Steps per frame of the integral of the speed: a pause of 10 frames is exact to .02 of a frame."""
RAMP = 4.0
"""Frames in which the camera stops before a pause or a pan, and starts again."""
TURN_FRAMES = (8.0, 15.0)
"""Range of the duration of a fast turn, frames."""
STOP_FRAMES = (10.0, 30.0)
"""Range of the duration of a pause or a pan without its ramps, frames."""
FIRST_EVENT, LAST_EVENT = 25.0, 8.0
"""Frames before the first pause, pan or turn, in which a map can start, and after the last one."""


def street(seed: int) -> list[Rectangle]:
    """A straight street with boxes of random size along both sides, closed at its end; z from 0 along it."""
    painter = Painter(np.random.default_rng(seed))
    width, height, length = STREET
    rectangles = painter.box((0.0, 0.0, length / 2), (width, height, length), 0.0)
    for along in np.arange(HOUSES_EVERY, length - 0.5, HOUSES_EVERY):
        for side in (-1.0, 1.0):
            x, y, z = painter.rng.uniform((0.2, 0.3, 0.2), (0.5, 1.3, 0.6))
            place = along + painter.rng.uniform(-0.3, 0.3)
            center = (side * (width / 2 - x / 2), height / 2 - y / 2, place)
            rectangles += painter.box(center, (x, y, z), painter.rng.uniform(-0.3, 0.3))
    return rectangles


BUILDERS = {"room": room, "wall": wall, "street": street}
MOTIONS = ("smooth", "pause", "pan", "turn", "all")
"""What happens on the way: nothing; the camera stands still; it only rotates; it rotates fast; all of it."""
_MAX_YAW = {"room": 0.5, "wall": 0.15, "street": 0.12}
"""Radians: maximum amplitude of the slow rotation about the vertical axis. The wall stays in view."""
_PAN = {"room": (0.2, 0.7), "wall": (0.1, 0.25), "street": (0.2, 0.6)}
"""Radians: range of the angle of a pan or a fast turn. The wall stays in view."""


@dataclass(frozen=True)
class Wave:
    """A sine of the progress in frames."""

    amplitude: float
    period: float
    phase: float

    def __call__(self, progress: np.ndarray) -> np.ndarray:
        return self.amplitude * np.sin(2 * math.pi * progress / self.period + self.phase)


@dataclass(frozen=True)
class Event:
    """A part of the path in which the camera stops, rotates, or both.

    Attributes:
        start: frame at which it begins
        frames: duration, ramps included
        stops: whether the camera stops meanwhile
        turn: radians by which it rotates about the vertical axis
    """

    start: float
    frames: float
    stops: bool
    turn: float = 0.0

    def speed(self, time: np.ndarray) -> np.ndarray:
        """Speed of the camera along its path, 1 outside of the event."""
        if not self.stops:
            return np.ones_like(time)
        inside = np.minimum(time - self.start, self.start + self.frames - time)
        return 1.0 - smooth_step(inside / RAMP)

    def yaw(self, time: np.ndarray) -> np.ndarray:
        """Rotation so far, radians."""
        ramp = RAMP if self.stops else 0.0
        return self.turn * smooth_step((time - self.start - ramp) / (self.frames - 2 * ramp))


@dataclass(frozen=True)
class Path:
    """A random path: six sums of sines of the progress, which stands still in events; a street is also driven along.

    Attributes:
        waves: of x, y, z (meters), yaw, pitch and roll (radians)
        origin: (3,) meters
        forward: meters per frame along z
        events: pauses, pans and turns
        progress: at the times `WARP_STEPS` apart, from one frame before the first to one after the last
    """

    waves: tuple[tuple[Wave, ...], ...]
    origin: tuple[float, float, float]
    forward: float
    events: tuple[Event, ...]
    progress: np.ndarray

    @classmethod
    def random(cls, rng: np.random.Generator, scene: str, motion: str, frames: int) -> Path:
        """Draw a path through a scene of `BUILDERS`, with what a motion of `MOTIONS` has on the way."""
        is_street = scene == "street"
        ranges = (  # of the amplitudes
            (0.05, 0.25) if is_street else (0.4, 1.1),
            (0.01, 0.05) if is_street else (0.1, 0.25),
            (0.0, 0.02) if is_street else (0.2, 0.5),
            (0.03, _MAX_YAW[scene]),
            (0.02, 0.08),
            (0.01, 0.05),
        )
        shakes = (0.004, 0.004, 0.004, 0.006, 0.005, 0.004)  # of a hand: meters, radians
        strength = rng.uniform(0.0, 1.0)
        waves = tuple(
            (
                Wave(rng.uniform(*limits), rng.uniform(45, 140), rng.uniform(0, 2 * math.pi)),
                Wave(strength * shake, rng.uniform(7, 15), rng.uniform(0, 2 * math.pi)),
            )
            for limits, shake in zip(ranges, shakes, strict=True)
        )
        origin = {"room": (0.0, -0.1, -0.7), "wall": (0.0, 0.0, 0.0), "street": (0.0, -0.1, 0.4)}[scene]
        forward = rng.uniform(0.03, 0.1) if is_street else 0.0
        events = _events(rng, scene, motion, frames)
        time = np.arange(-WARP_STEPS, (frames + 1) * WARP_STEPS) / WARP_STEPS
        speed = np.prod([np.ones_like(time), *(event.speed(time) for event in events)], axis=0)
        return cls(waves, origin, forward, events, np.cumsum(speed) / WARP_STEPS)

    def T_wc(self, time: np.ndarray) -> Float[Tensor, "N 4 4"]:
        """The poses at times (N,) in frames."""
        progress = np.interp(time, np.arange(len(self.progress)) / WARP_STEPS - 1.0, self.progress)
        x, y, z, yaw, pitch, roll = (np.sum([wave(progress) for wave in some], axis=0) for some in self.waves)
        for event in self.events:
            yaw = yaw + event.yaw(time)
        z = z + self.forward * progress
        numbers = (x + self.origin[0], y + self.origin[1], z + self.origin[2], yaw, pitch, roll)
        return poses(*(torch.from_numpy(np.asarray(each, dtype=np.float64)) for each in numbers))


def _events(rng: np.random.Generator, scene: str, motion: str, frames: int) -> tuple[Event, ...]:
    """One event of each kind of the motion, in random order, each in its own part of the path."""
    kinds = {"smooth": [], "all": ["pause", "pan", "turn"]}.get(motion, [motion])
    rng.shuffle(kinds)
    if motion == "pan":
        kinds = ["pan", "pan"]  # there and back
    space = (frames - FIRST_EVENT - LAST_EVENT) / max(len(kinds), 1)
    events = []
    turn = float(rng.uniform(*_PAN[scene]) * rng.choice((-1, 1)))
    for number, kind in enumerate(kinds):
        stops = kind != "turn"
        duration = rng.uniform(*(STOP_FRAMES if stops else TURN_FRAMES)) + (2 * RAMP if stops else 0.0)
        duration = min(duration, space)
        start = FIRST_EVENT + number * space + rng.uniform(0.0, space - duration)
        events.append(Event(start, duration, stops, 0.0 if kind == "pause" else turn))
        if kind != "pause":
            turn = -turn
    return tuple(events)


def smooth_step(x: np.ndarray) -> np.ndarray:
    """From 0 below 0 to 1 above 1, with a slope of zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


class RenderedSequence(Sequence):
    """A path through a scene, all its images rendered in advance.

    Args:
        name: of the sequence.
        scene: of `BUILDERS`, with its seed.
        path: of the camera.
        frames: number of frames.
        true: the camera that images are rendered with.
        given: the camera of the sequence.
        readout_ms: from the exposure of the first row to the last, whose middle has the frame's pose.
        noise: standard deviation, gray levels of 255.
        blur: standard deviation of a Gaussian, pixels.
        seed: of the noise.
    """

    def __init__(
        self,
        name: str,
        scene: tuple[str, int],
        path: Path,
        frames: int,
        true: Camera,
        given: Camera,
        readout_ms: float,
        noise: float,
        blur: float,
        seed: int,
    ) -> None:
        times = torch.arange(frames, dtype=torch.float64, device="cpu") / FRAME_RATE
        truth = Trajectory(times, path.T_wc(np.arange(frames, dtype=np.float64)))
        super().__init__(name, "rendered", given, times, truth)
        renderer = _renderer(*scene, true.size, tuple(true.params[:4].tolist()))
        rng = np.random.default_rng(seed)
        rows = (np.arange(true.height) + 0.5) / true.height - 0.5 if readout_ms else np.zeros(1)
        self._images = []
        for index in range(frames):
            T_wc = path.T_wc(index + 1e-3 * readout_ms * FRAME_RATE * rows)
            image = cv2.GaussianBlur(renderer.render(se3_inverse(T_wc).numpy()), (0, 0), blur)
            image = image + np.float32(noise) * rng.standard_normal(image.shape, dtype=np.float32)
            self._images.append(image.round().clip(0, 255).astype(np.uint8))

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        return gray_to_tensor(self._images[index])

    def image_name(self, index: int) -> str:
        return f"{self.name}#{index}"


class Zoomed(Transformed):
    """Sequence with a zoom: the images enlarged about the principal point, by a ratio for each."""

    def __init__(self, whole: Sequence, ratios: list[float]) -> None:
        super().__init__(whole)
        self._ratios, self._same_pixels = ratios, False

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        return unzoomed_image(super().image(index)[0, 0], 1 / self._ratios[index], self.camera)[None, None]


@lru_cache(maxsize=2)
def _rectangles(scene: str, seed: int) -> list[Rectangle]:
    """Textures take seconds to make: the last scenes are kept. Cases are run scene by scene."""
    return BUILDERS[scene](seed)


def _renderer(
    scene: str, seed: int, size: tuple[int, int], params: tuple[float, float, float, float]
) -> Renderer:
    fx, fy, cx, cy = params
    return Renderer(_rectangles(scene, seed), np.array(((fx, 0, cx), (0, fy, cy), (0, 0, 1))), size)
