"""How far the poses of clips are from the true ones."""

from __future__ import annotations

import math

import torch

from torchslam import ClipSLAM, clip_loss
from torchslam.data.sequence import Sequence
from torchslam.learning.dataset import Clip, frames_in
from torchslam.learning.losses import relative_ate

FRAMES = 8
STEP_S = 0.15  # between the frames of a clip


def clip_from(sequence: Sequence, start: int, device: torch.device) -> Clip:
    """The clip that begins at a frame; images go to the device, geometry stays here."""
    return Clip.of(sequence, start, FRAMES, frames_in(STEP_S, sequence), supervised=True).to(device)


@torch.no_grad()
def position_error(clip_slam: ClipSLAM, clip: Clip) -> float:
    """ATE as a share of the path, NaN where there are no poses to compare."""
    poses = clip_slam(clip.images, clip.camera)
    return float(clip_loss(poses, clip.T_cw, relative_ate, on_failure=math.nan).loss)
