"""Localization problems whose matches are chosen once: keypoints followed through views around a base frame.

The extractor stays as it is and matching is discrete, so both are done before the training. What is left of an image
are its keypoints and the patches around them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from experiments.learned_weights.features.front_end import patches
from torchslam import Camera, match
from torchslam.data.sequence import Sequence
from torchslam.geometry import triangulate_many
from torchslam.types import Features

VIEWS_S = (-0.4, -0.2, 0.0, 0.2, 0.4)  # seconds from the base frame
MAX_DISTANCE = 0.25  # 1 - cosine
MAX_ERROR = 4.0  # pixels; matches further from the true poses are taken for wrong ones
MIN_PARALLAX = 0.01  # radians
MIN_VIEWS = 3  # that see a track: two make the point, the third is localized


@dataclass(frozen=True)
class Tracks:
    """P problems of T tracks, padded, over V views each, of F frames of N keypoints.

    keypoints: (F, N, 2) float64 pixels; patches: (F, N, D) around them, input of the network
    T_cw:      (F, 4, 4) true poses; camera: of all frames
    frames:    (P, V) rows of keypoints
    indices:   (P, T, V) keypoints of these frames; seen: (P, T, V) bool
    """

    keypoints: Tensor
    patches: Tensor
    T_cw: Tensor
    camera: Camera
    frames: Tensor
    indices: Tensor
    seen: Tensor

    def __len__(self) -> int:
        return len(self.frames)

    @classmethod
    @torch.no_grad()
    def of(cls, extractor: nn.Module, sequence: Sequence, part: range, device: torch.device) -> Tracks:
        """All problems with their frames in a part of a sequence; every image is read once."""
        poses = [sequence.pose(index) for index in part]
        if any(pose is None for pose in poses):
            raise ValueError(f"{sequence.name}: a frame from {part.start} to {part.stop} has no true pose")
        T_cw = torch.stack([pose for pose in poses if pose is not None])
        features, around = [], []
        for index in part:
            image = sequence.image(index).to(device)
            found = extractor(image)
            around.append(patches(image, found.keypoints)[0].cpu())
            features.append(found.to("cpu"))
        keypoints = torch.stack([one.keypoints[0].double() for one in features])
        offsets = [round(seconds * sequence.frame_rate) for seconds in VIEWS_S]
        frames, indices, seen = [], [], []
        for base in range(-offsets[0], len(part) - offsets[-1]):
            views = [base + offset for offset in offsets]
            columns, found_in = follow(features, base, views)
            used = agreeing(keypoints, T_cw, sequence.camera, torch.tensor(views), columns, found_in)
            frames.append(torch.tensor(views))
            indices.append(columns[used])
            seen.append(found_in[used])
        return cls(
            keypoints,
            torch.stack(around),
            T_cw,
            sequence.camera,
            torch.stack(frames),
            nn.utils.rnn.pad_sequence(indices, batch_first=True),
            nn.utils.rnn.pad_sequence(seen, batch_first=True),
        )


def follow(features: list[Features], base: int, views: list[int]) -> tuple[Tensor, Tensor]:
    """The keypoints (N, V) of views that match those of a base frame, and whether there is one (N, V)."""
    known = features[base]
    columns, found = [], []
    for view in views:
        if view == base:
            columns.append(torch.arange(known.mask.shape[1]))
            found.append(known.mask[0])
        else:
            matches = match(known, features[view], max_distance=MAX_DISTANCE)
            columns.append(matches.indices_2[0])
            found.append(matches.mask[0])
    return torch.stack(columns, -1), torch.stack(found, -1)


def agreeing(
    keypoints: Tensor, T_cw: Tensor, camera: Camera, views: Tensor, columns: Tensor, found: Tensor
) -> Tensor:
    """(N,) which tracks make a point that all their views, with their true poses, see about where it is."""
    pixels, pinhole = straightened(keypoints[views, columns], camera)
    points = triangulate_many(pixels, T_cw=T_cw[views], camera=pinhole, mask=found)
    near = ((points.errors < MAX_ERROR) | ~found).all(-1)
    return (found.sum(-1) >= MIN_VIEWS) & points.mask & near & (points.angles > MIN_PARALLAX)


def straightened(pixels: Tensor, camera: Camera) -> tuple[Tensor, Camera]:
    """Pixels (..., 2) as a pinhole camera of the same focal length sees them, and that camera."""
    focal = float(camera.focal)
    straight = focal * camera.normalize(pixels.flatten(0, -2)).view_as(pixels)
    return straight, Camera.pinhole(focal, focal, 0.0, 0.0, size=camera.size)
