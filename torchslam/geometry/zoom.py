"""A zoom: the focal length of each frame of a recording, as a ratio to that of its camera.

Phones change the focal length by one to three percent when they focus, and people zoom. Undone, images and keypoints
are those of a camera with one focal length, which every stage works with; the distortion zooms with them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.utils.by_value import ByValue

LARGEST_RATIO = 100.0
"""Largest ratio that is read from a file: zoom lenses have up to 30. Tried at this value only."""


@dataclass(frozen=True, eq=False)
class Zoom(ByValue):
    """Ratios of focal lengths by frame.

    Attributes:
        frames: indices of frames in their sequence, ascending. Between them logarithms are linear, and before the
            first and after the last one the ratio is theirs.
        ratios: focal length of each to that of the camera.
    """

    frames: Int[Tensor, " N"]
    ratios: Float[Tensor, " N"]

    def at(self, frames: Int[Tensor, " F"]) -> Float[Tensor, " F"]:
        """The ratios of frames."""
        known, logs = self.frames.to(frames), self.ratios.log().to(frames.device)
        after = torch.searchsorted(known, frames).clamp(1, max(len(known) - 1, 1))
        before, after = after - 1, after.clamp_max(len(known) - 1)
        width = (known[after] - known[before]).clamp_min(1)
        share = ((frames - known[before]) / width).clamp(0, 1).to(logs)
        return (logs[before] + share * (logs[after] - logs[before])).exp()

    def then(self, other: Zoom) -> Zoom:
        """This zoom and another one of its images, after it was undone."""
        frames = torch.unique(torch.cat((self.frames, other.frames)))
        return Zoom(frames, self.at(frames) * other.at(frames))

    def beyond(self, other: Zoom | None) -> Zoom:
        """What is left of this zoom where another one is undone."""
        return self if other is None else Zoom(self.frames, self.ratios / other.at(self.frames))

    @property
    def extent(self) -> float:
        """Logarithm of the largest focal length to the smallest one."""
        logs = self.ratios.log()
        return float(logs.max() - logs.min())

    def undone(
        self, pixels: Float[Tensor, "F *rows 2"], frames: Int[Tensor, " F"], camera: Camera
    ) -> Float[Tensor, "F *rows 2"]:
        """The pixels of frames as the camera would have seen them with its own focal length."""
        ratios = self.at(frames).to(pixels).view(-1, *(1 for _ in pixels.shape[1:]))
        center = camera.params[2:4].detach().to(pixels)
        return center + (pixels - center) / ratios

    @property
    def plain(self) -> dict[str, Any]:
        """As JSON has it."""
        return {"frames": self.frames.tolist(), "ratios": self.ratios.tolist()}

    @classmethod
    def from_plain(cls, plain: Any) -> Self:
        """Invert `plain`. Raises ValueError for anything else."""
        try:
            frames = torch.tensor(plain["frames"], dtype=torch.int64, device="cpu")
            ratios = torch.tensor(plain["ratios"], dtype=torch.float64, device="cpu")
        except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise ValueError(f"no frames and ratios: {error}") from None
        if frames.ndim != 1 or frames.shape != ratios.shape or not len(frames):
            raise ValueError(f"{tuple(frames.shape)} frames and {tuple(ratios.shape)} ratios")
        is_ratio = (ratios > 1 / LARGEST_RATIO) & (ratios < LARGEST_RATIO)
        if bool((frames.diff() <= 0).any()) or not bool(is_ratio.all()):
            raise ValueError("frames that do not ascend, or ratios that are none")
        return cls(frames, ratios)
