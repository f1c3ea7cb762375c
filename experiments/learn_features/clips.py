"""Clips of sequences with their true poses, and how far estimated poses are from them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam import Camera, ClipPoses, ClipSLAM
from torchslam.data.sequence import Sequence
from torchslam.evaluation import MIN_POSES, ate, rpe
from torchslam.geometry import se3_inverse

STEP_S = 0.15  # between the frames of a clip


@dataclass(frozen=True)
class Clip:
    """images (T, 1, H, W), true poses T_cw (T, 4, 4) in metres, and the camera of both."""

    images: Tensor
    T_cw: Tensor
    camera: Camera

    @property
    def path_length(self) -> Tensor:
        """() metres."""
        return se3_inverse(self.T_cw)[:, :3, 3].diff(dim=0).norm(dim=-1).sum()

    @classmethod
    def of(cls, sequence: Sequence, start: int, frames: int, step: int, device: torch.device) -> Clip:
        """The frames `start`, `start + step`, ... of a sequence; images go to the device, geometry stays here."""
        part = sequence.part(start, start + frames * step, step)
        found = list(part)
        poses = [frame.T_cw_groundtruth for frame in found if frame.T_cw_groundtruth is not None]
        if len(poses) < frames:
            raise ValueError(f"{sequence.name}: a clip from frame {start} lacks frames or true poses")
        return cls(
            torch.cat([frame.image for frame in found]).to(device), torch.stack(poses), sequence.camera
        )


def step_of(sequence: Sequence) -> int:
    """Frames that make up STEP_S."""
    return max(1, round(STEP_S * sequence.frame_rate))


@dataclass(frozen=True)
class Errors:
    """Of one clip: neither depends on the world and the unit of length of the estimate.

    position:     ATE as a share of the path; rotation: RMS of the rotation from frame to frame, radians
    posed, seen:  frames with a pose; observations that agree with it
    """

    position: Tensor
    rotation: Tensor
    posed: int
    seen: int

    @property
    def enough(self) -> bool:
        """Whether there are more poses than fit any path."""
        return self.posed > MIN_POSES


def errors_of(clip_slam: ClipSLAM, clip: Clip) -> Errors:
    """Run the system on a clip and compare with the true poses, differentiably."""
    poses: ClipPoses = clip_slam(clip.images, clip.camera)
    position = ate(poses.T_cw, clip.T_cw, poses.posed) / clip.path_length
    rotation = rpe(poses.T_cw, clip.T_cw, mask=poses.posed)[1]
    seen = sum(len(graph.pixels) for graph in poses.graphs if graph is not None)
    return Errors(position, rotation, int(poses.posed.sum()), seen)
