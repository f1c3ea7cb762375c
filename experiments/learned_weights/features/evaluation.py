"""Errors of a feature extractor: of the relative poses of pairs of views, and of the poses of clips."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from experiments.benchmarks.problems import match_pixels
from torchslam import Camera, ClipSLAM, Features, clip_loss, estimate_relative_pose
from torchslam.data.sequence import Sequence
from torchslam.geometry import RelativePose, se3_inverse
from torchslam.learning.dataset import Clip, frames_in
from torchslam.learning.losses import motion_difference, relative_ate

APART_S = 0.3
THRESHOLD_PX = 1.5
FRAMES = 8
STEP_S = 0.15  # between the frames of a clip


@dataclass(frozen=True)
class Pair:
    """images (2, 1, H, W) of two frames APART_S apart, the true motion T_21 (4, 4), and the camera."""

    images: Tensor
    T_21: Tensor
    camera: Camera

    @classmethod
    def of(cls, sequence: Sequence, start: int, device: torch.device) -> Pair:
        clip = Clip.of(sequence, start, 2, frames_in(APART_S, sequence), supervised=True).to(device)
        return cls(clip.images, clip.T_cw[1] @ se3_inverse(clip.T_cw[0]), clip.camera)


@dataclass(frozen=True)
class PairErrors:
    """Of P pairs, (P,) each; NaN, for inliers 0, where no motion fits.

    rotation, direction: radians, of the motion against the true one; direction is that of the translation
    rotation_halves, direction_halves: radians, between the motions estimated from two halves of the matches.
                         Nothing true is needed for these, so nothing wrong in it counts.
    inliers:             within THRESHOLD_PX
    """

    rotation: Tensor
    direction: Tensor
    rotation_halves: Tensor
    direction_halves: Tensor
    inliers: Tensor

    @property
    def angles(self) -> Tensor:
        """(4, P) all but the inliers."""
        return torch.stack([self.rotation, self.direction, self.rotation_halves, self.direction_halves])

    @staticmethod
    def cat(rows: list[PairErrors]) -> PairErrors:
        return PairErrors(*(torch.cat([getattr(row, f.name) for row in rows]) for f in fields(PairErrors)))


@torch.no_grad()
def pair_errors(features: Features, pair: Pair) -> PairErrors:
    """Relative pose by five-point RANSAC from the features of both images, against the true one; P = 1."""
    pixels_1, pixels_2 = matched_pixels(features)
    whole = motion_of(pixels_1, pixels_2, pair.camera)
    even, odd = (motion_of(pixels_1[half::2], pixels_2[half::2], pair.camera) for half in (0, 1))
    against_truth = motion_difference(whole.T_21[0], pair.T_21).norm(dim=-1) + _failed(whole)
    halves = motion_difference(even.T_21[0], odd.T_21[0]).norm(dim=-1) + _failed(even) + _failed(odd)
    inliers = whole.inliers.sum(-1).to(against_truth.dtype)
    (rotation, direction), (rotation_halves, direction_halves) = against_truth.split(1), halves.split(1)
    return PairErrors(rotation, direction, rotation_halves, direction_halves, inliers)


def matched_pixels(features: Features) -> tuple[Tensor, Tensor]:
    """(M, 2) pixels of the matches in both images."""
    limit = 64 if features.descriptors.dtype == torch.uint8 else 0.25
    return match_pixels(features[:1], features[1:], max_distance=limit)


def motion_of(pixels_1: Tensor, pixels_2: Tensor, camera: Camera) -> RelativePose:
    """The relative pose of matches (M, 2) within a threshold, as in map initialization."""
    return estimate_relative_pose(
        pixels_1[None],
        pixels_2[None],
        camera_1=camera,
        camera_2=camera,
        threshold=THRESHOLD_PX,
        kernel="truncated",
        min_samples=64,
    )


def _failed(motion: RelativePose) -> float:
    return 0.0 if motion.success[0] else float("nan")


def clip_from(sequence: Sequence, start: int, device: torch.device) -> Clip:
    """The clip that begins at a frame, its images on the device."""
    return Clip.of(sequence, start, FRAMES, frames_in(STEP_S, sequence), supervised=True).to(device)


@torch.no_grad()
def position_error(clip_slam: ClipSLAM, clip: Clip) -> float:
    """ATE as a share of the path, NaN where there are no poses to compare."""
    poses = clip_slam(clip.images, clip.camera)
    return float(clip_loss(poses, T_cw_groundtruth=clip.T_cw, error=relative_ate, on_failure=math.nan).loss)
