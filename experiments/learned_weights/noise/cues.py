"""Cues for the accuracy of an ORB keypoint: level, response, contrast, shape, neighborhood."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam import ORB, Features
from torchslam.features.corners import patch_scores
from torchslam.features.matching.hamming import hamming
from torchslam.features.pyramid import build_levels, gather_level_patches, plan_pyramid

NAMES = (
    "level",
    "response",
    "peakedness",
    "contrast",
    "gradient",
    "isotropy",
    "offset",
    "distance",
    "ambiguity",
    "sharpness",
)
"""level: log of the scale; response: log of the FAST score; peakedness: log of by how much it exceeds the mean of its
eight neighbors; contrast: log of the standard deviation of gray values, gradient: log of the mean squared gradient,
isotropy: log of the ratio of the structure tensor's eigenvalues, the smaller one first, all of the 9 x 9 pixels of the
level; offset: pixels of the level between the keypoint and the nearest pixel; distance: log of that to the nearest
other keypoint, in scales; ambiguity: bits by which the most similar other descriptor of the image differs, of 256;
sharpness: the median gradient of the image's keypoints, which motion blur lowers."""

RADIUS = 4
_BITS = 256
_NEAR = 0.5  # scales: keypoints of two levels at one place are no nearer than that to each other
_FLAT = 1.0  # gray value: the noise of a camera, below which contrast is meaningless


@dataclass(frozen=True)
class Cues:
    """Of keypoints (B, N): values (B, N, len(NAMES)), and directions (B, N, 2, 2), their structure tensors divided by
    half the trace; what is masked is finite."""

    values: Tensor
    directions: Tensor


@torch.no_grad()
def describe(orb: ORB, images: Tensor, features: Features) -> Cues:
    """The cues of what ORB found in images (B, 1, H, W)."""
    batch, number = features.mask.shape
    atlas = plan_pyramid(*images.shape[-2:], orb.scale_factor, orb.num_levels)
    level = (features.scales.log() / math.log(orb.scale_factor)).round().to(torch.int64)
    sizes = images.new_tensor(atlas.scales)[level]
    xy = (features.keypoints + 0.5) / sizes - 0.5
    centers = torch.where(features.mask[..., None], xy.round().to(torch.int64), RADIUS)
    of = torch.arange(batch, device=images.device)[:, None].expand(-1, number)
    level = torch.where(features.mask, level, 0)
    patches = gather_level_patches(
        build_levels(images, atlas), of.flatten(), level.flatten(), centers.flatten(0, 1), RADIUS
    )
    tensors = structure_tensors(patches)
    trace = tensors.diagonal(dim1=-2, dim2=-1).sum(-1)
    gap = ((tensors[:, 0, 0] - tensors[:, 1, 1]).square() + 4 * tensors[:, 0, 1].square()).sqrt()
    fast = patch_scores(patches).flatten(1)
    gradient = (trace + _FLAT).log().view(batch, number)
    alone = (
        (fast[:, 4] + 1).log(),
        (fast[:, 4] - fast.mean(1) + 1).clamp_min(1).log(),
        (patches.flatten(1).std(1) + _FLAT).log(),
        gradient.flatten(),
        ((trace - gap + _FLAT) / (trace + gap + _FLAT)).log(),
    )
    response, peakedness, contrast, _, isotropy = (values.view(batch, number) for values in alone)
    median = gradient.masked_fill(~features.mask, torch.nan).nanmedian(-1, keepdim=True).values
    values = torch.stack(
        (
            features.scales.log(),
            response,
            peakedness,
            contrast,
            gradient,
            isotropy,
            (xy - centers).norm(dim=-1).clamp_max(1.0),
            *_neighborhoods(features),
            median.nan_to_num().expand_as(gradient),
        ),
        dim=-1,
    )
    eye = torch.eye(2, dtype=tensors.dtype, device=tensors.device)
    directions = (2 * tensors + _FLAT * eye) / (trace + _FLAT)[:, None, None]
    return Cues(values, directions.view(batch, number, 2, 2))


def structure_tensors(patches: Tensor) -> Tensor:
    """(n, 2, 2) means of the products of the gradients, central differences, inside patches (n, S, S)."""
    dx = (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]).flatten(1) / 2
    dy = (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]).flatten(1) / 2
    gradients = torch.stack((dx, dy), dim=1)
    return gradients @ gradients.mT / dx.shape[1]


def _neighborhoods(features: Features) -> tuple[Tensor, Tensor]:
    """(B, N) each: log distance in scales to the nearest other keypoint, share of bits to the most similar one."""
    apart = torch.cdist(features.keypoints, features.keypoints)
    none = ~features.mask[:, None, :] | torch.eye(apart.shape[-1], dtype=torch.bool, device=apart.device)
    nearest = apart.masked_fill(none, torch.inf).amin(-1) / features.scales
    bits = torch.stack([hamming(each, each) for each in features.descriptors])
    similar = bits.masked_fill(none, _BITS).amin(-1) / _BITS
    return nearest.clamp(_NEAR, _BITS).log(), similar.to(nearest)
