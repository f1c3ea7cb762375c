"""Rendered sequences, opened by name as `synthetic:room?frames=240&noise=4`, and the smooth paths of their camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from urllib.parse import parse_qsl

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchslam.data.calibration import Calibration, GivenCamera
from torchslam.data.formats.image_file import gray_to_tensor, read_gray
from torchslam.data.sequence import Calibrated, Reader, Sequence
from torchslam.data.synthetic.renderer import Renderer
from torchslam.data.synthetic.scene import Rectangle, corridors, room, rooms, wall
from torchslam.errors import CalibrationError, SequenceError
from torchslam.features.weights import downloads
from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import rigid, se3_inverse, so3_exp
from torchslam.types import Trajectory
from torchslam.utils.files import fingerprint, write_whole

FRAME_RATE = 20.0  # frames per second
SIZE = (640, 480)  # width and height of the images, pixels
FOCAL = 500.0  # pixels: 65 degrees over the width
RADIUS = 2.87  # meters: the length of the walk around the core by 2 pi
OUTWARD = 0.5  # radians from the heading to where the camera looks
HARMONICS = ((1, 0.98444), (-3, -0.04134), (5, -0.02481), (-7, -0.00111), (9, 0.00086))
"""Fourier series of the integral of exp(i (phase - sin(4 phase) / 4)): orders 1 - 4 n,
weights J_n(1 / 4) / (1 - 4 n)."""


def loop(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """A figure of eight through the middle of the room, one round a phase of 2 pi, held in a hand that sways.

    The sway's periods do not divide the round's, so that no two rounds are the same.
    """
    x = 1.1 * torch.sin(phase) + 0.02 * torch.sin(7.3 * phase)
    y = -0.1 + 0.12 * torch.sin(2.0 * phase + 0.5) + 0.015 * torch.sin(11.7 * phase)
    z = -0.5 - 0.55 * torch.sin(2.0 * phase) + 0.02 * torch.sin(5.9 * phase + 1.0)
    yaw = 0.45 * torch.sin(phase - 0.9) + 0.02 * torch.sin(9.1 * phase)
    pitch = 0.08 * torch.sin(2.0 * phase + 1.3) + 0.015 * torch.sin(8.3 * phase + 0.4)
    roll = 0.05 * torch.sin(phase + 0.7) + 0.01 * torch.sin(10.3 * phase)
    return poses(x, y, z, yaw, pitch, roll)


def standstill(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """No motion at all."""
    return poses(*[torch.zeros_like(phase)] * 6)


def rotation(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """A camera that turns about its own center and back."""
    zero = torch.zeros_like(phase)
    return poses(zero, zero, zero, 0.7 * torch.sin(phase), 0.2 * torch.sin(2 * phase), 0.1 * torch.sin(phase))


def sideways(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """A slow walk along the wall and back, turned toward it from changing angles."""
    return poses(
        1.2 * torch.sin(phase),
        0.2 * torch.sin(2 * phase),
        0.4 * torch.sin(phase + 0.5),
        -0.25 * torch.sin(phase),
        0.08 * torch.sin(2 * phase),
        0.05 * torch.sin(phase),
    )


def round_the_core(phase: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
    """Around the core of the four rooms, one round a phase of 2 pi, from the door into the first room, to the right.

    The heading is phase - sin(4 phase) / 4: straight on at the four doors, twice the mean rate in the four corners,
    at constant speed. Its integral closes for the fourfold symmetry; `HARMONICS` is its Fourier series. The camera
    looks to the left of the heading, at the outer walls, and sways in the hand.
    """
    z = RADIUS * sum(weight * torch.sin(order * phase) for order, weight in HARMONICS)
    x = -RADIUS * sum(weight * torch.cos(order * phase) for order, weight in HARMONICS)
    return poses(
        x + 0.012 * torch.sin(29.3 * phase),
        0.015 * torch.sin(47.3 * phase) + 0.05 * torch.sin(3.3 * phase + 0.5),
        z + 0.012 * torch.sin(23.9 * phase + 1.0),
        phase - 0.25 * torch.sin(4 * phase) - OUTWARD + 0.015 * torch.sin(36.4 * phase),
        -0.03 + 0.012 * torch.sin(31.7 * phase + 0.4),
        0.01 * torch.sin(41.2 * phase),
    )


def poses(x: Tensor, y: Tensor, z: Tensor, yaw: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """T_wc from position, meters, and angles, radians: about y, then x, then z of the camera."""
    zero = torch.zeros_like(x)
    turns = ((zero, yaw, zero), (pitch, zero, zero), (zero, zero, roll))
    about_y, about_x, about_z = (so3_exp(torch.stack(turn, dim=-1)) for turn in turns)
    return rigid(about_y @ about_x @ about_z, torch.stack((x, y, z), dim=-1))


@dataclass(frozen=True)
class Scene:
    """A scene, built from a seed, and the path of the camera in it, T_wc from the phase of each frame.

    A phase of 2 pi has a number of frames, and the sequence another one by default.
    """

    build: Callable[[int], list[Rectangle]]
    path: Callable[[Tensor], Tensor]
    frames_per_round: int = 160
    frames: int = 160


SCENES = {
    "room": Scene(room, loop),
    "planar": Scene(wall, sideways),
    "rotation": Scene(room, rotation),
    "standstill": Scene(room, standstill),
    # Once around and 50 frames on, over the start.
    "loop": Scene(rooms, round_the_core, 670, 720),
    # Ends before the start comes into sight: what looks like a return is none. With 720 frames it returns.
    "corridors": Scene(corridors, round_the_core, 670, 560),
}


@dataclass(frozen=True)
class RenderOptions:
    """Options after the `?` in the name of a synthetic sequence.

    Attributes:
        frames: number of frames; None: that of the scene. A longer path repeats with another sway
        seed: of textures and noise
        noise: standard deviation, gray levels of 255
        blur: standard deviation of a Gaussian, pixels
        exposure: amplitude of a slow change of brightness, 0 to 1
        blank: 1: gray images instead of rendered ones, if only the poses are used
        readout: milliseconds from the exposure of the first row to the last, whose middle has the frame's pose
        pace: speed of the camera, 1 as the scene has it
        cache: 1: rendered images are kept on disk, in `torchslam/rendered` of the user's cache folder
    """

    frames: int
    seed: int = 0
    noise: float = 2.0
    blur: float = 0.5
    exposure: float = 0.0
    blank: int = 0
    readout: float = 0.0
    pace: float = 1.0
    cache: int = 0


class SyntheticSequence(Sequence):
    """Sequence whose frames are rendered on access; deterministic for a given name."""

    def __init__(self, scene: str, options: RenderOptions | None = None) -> None:
        self._scene = SCENES[scene]
        options = RenderOptions(self._scene.frames) if options is None else options
        self._step = 2 * math.pi / self._scene.frames_per_round  # in the phase, of a frame
        frames = torch.arange(options.frames, dtype=torch.float64, device="cpu")
        self._phases = frames * self._step * options.pace
        T_wc = self._scene.path(self._phases)
        timestamps = frames / FRAME_RATE
        center = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
        camera = Camera.pinhole(FOCAL, FOCAL, *center, size=SIZE)
        super().__init__(scene, "rendered", camera, timestamps, Trajectory(timestamps, T_wc))
        self._options = options
        self._last: tuple[int, np.ndarray] | None = None

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        options = self._options
        if options.blank:
            return torch.full((1, 1, SIZE[1], SIZE[0]), 0.5, dtype=torch.float32, device="cpu")
        if not options.cache:
            return gray_to_tensor(self._rendered(index))
        path = self._folder / f"{index:06d}.png"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, cv2.imencode(".png", self._rendered(index))[1].tobytes())
        return read_gray(path, self.image_name(index))

    @cached_property
    def _folder(self) -> Path:
        """Where rendered images are kept: the name has all that they depend on, and the code."""
        options = asdict(self._options) | {"frames": 0, "cache": 0}
        code = [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
        name = f"{self.name}-{fingerprint([sorted(options.items()), *code], 16)}"
        return downloads().parent / "rendered" / name

    def _rendered(self, index: int) -> UInt8[np.ndarray, "H W"]:
        """The image, which is kept: it is read again to be shown."""
        if self._last is None or self._last[0] != index:
            self._last = index, self._render(index)
        return self._last[1]

    def _render(self, index: int) -> UInt8[np.ndarray, "H W"]:
        options = self._options
        image = _renderer(self._scene.build, options.seed).render(self._row_poses(index))
        if options.blur > 0:
            image = cv2.GaussianBlur(image, (0, 0), options.blur)
        image *= 1.0 + options.exposure * np.sin(0.1 * index)
        # The noise of a frame does not depend on the order of access.
        rng = np.random.default_rng((options.seed, index))
        image += options.noise * rng.standard_normal(image.shape, dtype=np.float32)
        return image.round().clip(0, 255).astype(np.uint8)

    def _row_poses(self, index: int) -> np.ndarray:
        """T_cw (H, 4, 4) of the rows of an image; (1, 4, 4) if they are exposed at once."""
        options, phase = self._options, self._phases[index : index + 1]
        if options.readout > 0:
            fractions = (torch.arange(SIZE[1], dtype=torch.float64, device="cpu") + 0.5) / SIZE[1] - 0.5
            per_second = self._step * FRAME_RATE * options.pace
            phase = phase + per_second * 1e-3 * options.readout * fractions
        return se3_inverse(self._scene.path(phase)).numpy()

    def image_name(self, index: int) -> str:
        return f"synthetic:{self.name}#{index}"


def is_synthetic(path: str) -> bool:
    """Return True for the name of a rendered sequence."""
    return path.startswith("synthetic:")


def _open(path: str, camera: GivenCamera | None, rate: float | None) -> Sequence:
    """A rendered sequence, with its own camera or a guess, as if that were not known.

    Raises SequenceError, and CalibrationError for a camera that claims to be right.
    """
    sequence = open_synthetic(path)
    if camera is None:
        return sequence
    if not (isinstance(camera, Calibration) and camera.guessed):
        raise CalibrationError(f"{path}: rendered sequences have a fixed camera")
    return sequence.with_camera(camera.camera(sequence.size), Calibrated.GUESSED)


def open_synthetic(name: str) -> SyntheticSequence:
    """A rendered sequence from `synthetic:SCENE[?key=value&...]`, with the keys of RenderOptions.

    Raises SequenceError for an unknown scene or key, or a value out of range.
    """
    scene, _, query = name.removeprefix("synthetic:").partition("?")
    if scene not in SCENES:
        raise SequenceError(f"{name}: unknown scene `{scene}`; there are {', '.join(SCENES)}")
    options = RenderOptions(SCENES[scene].frames)
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in asdict(options):
            raise SequenceError(f"{name}: unknown option `{key}`; there are {', '.join(asdict(options))}")
        try:
            value = type(getattr(options, key))(text)
        except ValueError:
            raise SequenceError(f"{name}: `{key}` must be a number, got `{text}`") from None
        if not value >= (1 if key == "frames" else 0):
            raise SequenceError(f"{name}: `{key}` is out of range: {text}")
        options = replace(options, **{key: value})
    return SyntheticSequence(scene, options)


@lru_cache(maxsize=2)
def _renderer(build: Callable[[int], list[Rectangle]], seed: int) -> Renderer:
    """Textures take seconds to make, so that the last scenes are kept."""
    K = np.array(((FOCAL, 0, (SIZE[0] - 1) / 2), (0, FOCAL, (SIZE[1] - 1) / 2), (0, 0, 1)))
    return Renderer(build(seed), K, SIZE)


SYNTHETIC = Reader("synthetic:room", is_synthetic, _open)
