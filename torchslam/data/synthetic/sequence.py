"""Rendered sequences, opened by name: `synthetic:room`, `synthetic:room?frames=240&noise=4`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from urllib.parse import parse_qsl

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.calibration import Calibration, GivenCamera
from torchslam.data.formats.image_file import gray_to_tensor
from torchslam.data.sequence import Calibrated, Reader, Sequence
from torchslam.data.synthetic import paths
from torchslam.data.synthetic.renderer import Renderer
from torchslam.data.synthetic.scene import Rectangle, corridors, room, rooms, wall
from torchslam.errors import CalibrationError, SequenceError
from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_inverse
from torchslam.types import Trajectory

FRAME_RATE = 20.0
"""Frames per second."""
SIZE = (640, 480)
"""Width and height of the images, pixels."""
FOCAL = 500.0
"""Focal length, pixels: 65 degrees over the width."""


@dataclass(frozen=True)
class Scene:
    """A scene and the path of the camera in it.

    Attributes:
        build: rectangles from a seed
        path: T_wc from the phase of each frame
        frames_per_round: frames in a phase of 2 pi
        frames: default number of frames
    """

    build: Callable[[int], list[Rectangle]]
    path: Callable[[Tensor], Tensor]
    frames_per_round: int = 160
    frames: int = 160


SCENES = {
    "room": Scene(room, paths.loop),
    "planar": Scene(wall, paths.sideways),
    "rotation": Scene(room, paths.rotation),
    "standstill": Scene(room, paths.standstill),
    # Once around and 50 frames on, over the start.
    "loop": Scene(rooms, paths.round_the_core, 670, 720),
    # Ends before the start comes into sight: what looks like a return is none. With 720 frames it returns.
    "corridors": Scene(corridors, paths.round_the_core, 670, 560),
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
    """

    frames: int
    seed: int = 0
    noise: float = 2.0
    blur: float = 0.5
    exposure: float = 0.0
    blank: int = 0
    readout: float = 0.0
    pace: float = 1.0


class SyntheticSequence(Sequence):
    """Sequence whose frames are rendered on access; deterministic for a given name."""

    def __init__(self, scene: str, options: RenderOptions | None = None) -> None:
        self._scene = SCENES[scene]
        options = RenderOptions(self._scene.frames) if options is None else options
        self._phases = paths.phases(options.frames, self._scene.frames_per_round) * options.pace
        T_wc = self._scene.path(self._phases)
        timestamps = torch.arange(options.frames, dtype=torch.float64, device="cpu") / FRAME_RATE
        center = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
        camera = Camera.pinhole(FOCAL, FOCAL, *center, size=SIZE)
        super().__init__(scene, "rendered", camera, timestamps, Trajectory(timestamps, T_wc))
        self._options = options

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        options = self._options
        if options.blank:
            return torch.full((1, 1, SIZE[1], SIZE[0]), 0.5, dtype=torch.float32, device="cpu")
        image = _renderer(self._scene.build, options.seed).render(self._row_poses(index))
        if options.blur > 0:
            image = cv2.GaussianBlur(image, (0, 0), options.blur)
        image *= 1.0 + options.exposure * np.sin(0.1 * index)
        # The noise of a frame does not depend on the order of access.
        rng = np.random.default_rng((options.seed, index))
        image += options.noise * rng.standard_normal(image.shape, dtype=np.float32)
        return gray_to_tensor(image.round().clip(0, 255).astype(np.uint8))

    def _row_poses(self, index: int) -> np.ndarray:
        """T_cw (H, 4, 4) of the rows of an image; (1, 4, 4) if they are exposed at once."""
        options, phase = self._options, self._phases[index : index + 1]
        if options.readout > 0:
            fractions = (torch.arange(SIZE[1], dtype=torch.float64, device="cpu") + 0.5) / SIZE[1] - 0.5
            per_second = paths.phases(2, self._scene.frames_per_round)[1] * FRAME_RATE * options.pace
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
