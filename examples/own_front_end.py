"""A custom feature extractor and matcher:

torchslam run IMAGES -o results --features examples.own_front_end:Patches --matcher examples.own_front_end:nearest
"""

from dataclasses import replace

import torch

from torchslam import ORB, Features, Matches
from torchslam.types import FrameFeatures


class Patches(torch.nn.Module):
    """Images (B, 1, H, W) in [0, 1] to Features: ORB's corners, described by the gray values around them."""

    def __init__(self, num_keypoints: int = 1000) -> None:
        super().__init__()
        self.corners = ORB(num_keypoints)

    def forward(self, images: torch.Tensor) -> Features:
        found, size = self.corners(images), images.new_tensor([images.shape[3] - 1, images.shape[2] - 1])
        around = torch.stack(torch.meshgrid([torch.arange(-8.0, 9, 2)] * 2, indexing="xy"), -1).flatten(0, 1)
        places = found.keypoints[:, :, None] + found.scales[..., None, None] * around
        patches = torch.nn.functional.grid_sample(images, 2 * places / size - 1, align_corners=True)[:, 0]
        described = torch.nn.functional.normalize(patches - patches.mean(-1, keepdim=True), dim=-1)
        return replace(
            found, descriptors=described, information=(0.6 * found.scales) ** -2
        )  # accurate to 0.6 px


def nearest(view_1: FrameFeatures, view_2: FrameFeatures, prior: object) -> Matches:
    """Mutual nearest neighbors of the descriptors, anywhere in the images."""
    similar = view_1.descriptors @ view_2.descriptors.mT
    similar = similar.masked_fill(~view_1.mask[:, None] | ~view_2.mask, -1.0)
    (best, column), rows = similar.max(1), torch.arange(len(similar))
    good = (similar.argmax(0)[column] == rows) & (best > 0.8)
    return Matches(rows[None], column[None], 1 - best[None], good[None])
