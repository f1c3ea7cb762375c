"""Training through the error of poses: small draws of tracks, triangulated and localized in every step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.learned_weights.features.front_end import REACH, SubPixel
from experiments.learned_weights.features.tracks import MIN_PARALLAX, MIN_VIEWS, Tracks, straightened
from torchslam.geometry import Camera, se3_inverse, triangulate_many
from torchslam.learning.losses import pose_errors
from torchslam.learning.training import Training
from torchslam.optim import POSE_OPTIONS, solve_pose

UNIT = 3e-3  # of the errors, radians and shares of the median depth: about their median
KERNEL_PX = 1.5
MIN_TRACKS = 6


@dataclass(frozen=True)
class Settings:
    """steps: of the optimizer; problems: of a step; tracks: of a problem, resampled in every step

    Of few tracks a pose says more about each: the error is the sum of all their errors.
    """

    steps: int = 1000
    problems: int = 32
    tracks: int = 16
    learning_rate: float = 2e-3
    width: int = 64
    reach: float = REACH


@dataclass(frozen=True)
class Draw:
    """B problems of K tracks, and the view that is localized in all of them. Shapes as in `Tracks`."""

    frames: Tensor
    indices: Tensor
    seen: Tensor
    query: int


def draw(tracks: Tracks, settings: Settings, generator: torch.Generator) -> Draw:
    """Some problems, and of each some tracks that the localized view and two others see."""
    rows = torch.randint(len(tracks), (settings.problems,), generator=generator)
    query = int(torch.randint(tracks.frames.shape[1], (1,), generator=generator))
    seen = tracks.seen[rows]
    usable = seen[..., query] & (seen.sum(-1) >= MIN_VIEWS)
    keys = torch.rand(usable.shape, generator=generator).masked_fill(~usable, torch.inf)
    chosen = keys.argsort(-1)[:, : settings.tracks]
    picked = torch.arange(len(rows))[:, None], chosen
    return Draw(
        tracks.frames[rows],
        tracks.indices[rows][picked],
        (seen & usable[..., None])[picked],
        query,
    )


def drawn_pixels(extractor: SubPixel, tracks: Tracks, drawn: Draw) -> tuple[Tensor, Camera]:
    """(B, K, V, 2) where the network has the drawn tracks, as a pinhole camera sees them, and that camera."""
    frames = drawn.frames[:, None].expand_as(drawn.indices)
    device = next(extractor.parameters()).device
    moves = extractor.moves(tracks.patches[frames, drawn.indices].to(device)).cpu()
    return straightened(tracks.keypoints[frames, drawn.indices] + moves, tracks.camera)


def localization_errors(extractor: SubPixel, tracks: Tracks, drawn: Draw) -> tuple[Tensor, Tensor]:
    """Errors (B, 2) of position, as a share of the median depth, and rotation, radians; (B,) whether there is a pose.

    Points are triangulated with the true poses of the other views; the world is the true camera of the localized one,
    where its refinement starts as well.
    """
    pixels, pinhole = drawn_pixels(extractor, tracks, drawn)
    others = [view for view in range(pixels.shape[2]) if view != drawn.query]
    T_cw = tracks.T_cw[drawn.frames]
    T_vq = T_cw[:, others] @ se3_inverse(T_cw[:, drawn.query])[:, None]
    points = triangulate_many(pixels[:, :, others], T_cw=T_vq, camera=pinhole, mask=drawn.seen[..., others])
    mask = drawn.seen[..., drawn.query] & points.mask & (points.angles > MIN_PARALLAX)
    start = torch.eye(4, dtype=pixels.dtype).expand(len(pixels), 4, 4)
    refined = solve_pose(
        points.points_w,
        pixels[:, :, drawn.query],
        T_cw=start,
        camera=pinhole,
        mask=mask,
        options=POSE_OPTIONS.replace(scale=KERNEL_PX, iterations=8, tolerance=1e-6),
    )
    depths = points.points_w[..., 2].detach().masked_fill(~mask, torch.nan).nanmedian(-1).values
    success = refined.success & (mask.sum(-1) >= MIN_TRACKS) & (depths > 0)
    scales = torch.stack([torch.where(success, depths, 1.0), torch.ones_like(depths)], -1)
    return pose_errors(T_cw=refined.T_cw, T_cw_groundtruth=start) / scales, success


def pose_loss(extractor: SubPixel, tracks: Tracks, drawn: Draw) -> Tensor:
    """() the mean over problems of what grows like the logarithm of both errors, so that a few hopeless do not rule."""
    errors, success = localization_errors(extractor, tracks, drawn)
    each = (errors / UNIT).log1p().sum(-1)
    return torch.where(success, each, 0.0).sum() / success.sum().clamp_min(1)


def train(extractor: SubPixel, tracks: Tracks, settings: Settings, seed: int = 0) -> list[float]:
    """Train on new samples in every step; return the loss of each."""
    optimizer = torch.optim.Adam(extractor.network.parameters(), settings.learning_rate)
    training = Training(extractor.network, optimizer, settings.steps, seed)
    for _ in training:
        training.descend(pose_loss(extractor, tracks, draw(tracks, settings, training.generator)))
        if training.step % 250 == 0:
            mean = sum(training.losses[-250:]) / 250
            print(f"{training.step:5d}  mean loss of the last 250 {mean:.3f}", flush=True)
    return training.losses
