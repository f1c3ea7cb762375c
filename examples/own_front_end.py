"""A front end and a matcher of one's own, and a run with them:

torchslam run IMAGES -o results --features examples.own_front_end:Blobs --matcher examples.own_front_end:nearest
"""

from dataclasses import replace

import torch

from torchslam import Features, Matches
from torchslam.features import ORB


class Blobs(
    torch.nn.Module
):  # images (B, 1, H, W) in [0, 1] to Features: here ORB's corners, described by patches
    def __init__(self, num_keypoints: int = 1000) -> None:
        super().__init__()
        self.corners = ORB(num_keypoints)

    def forward(self, images: torch.Tensor) -> Features:
        found, (height, width) = self.corners(images), images.shape[-2:]
        around = torch.stack(torch.meshgrid(*[torch.arange(-8.0, 9, 2)] * 2, indexing="xy"), -1).flatten(0, 1)
        places = found.keypoints[:, :, None] + found.scales[..., None, None] * around.to(images)
        grid = 2 * places / places.new_tensor([width - 1, height - 1]) - 1
        patches = torch.nn.functional.grid_sample(images, grid, align_corners=True)[:, 0]
        described = torch.nn.functional.normalize(patches - patches.mean(-1, keepdim=True), dim=-1)
        information = (0.6 * found.scales) ** -2  # each is right to so many pixels
        return replace(found, descriptors=described, information=information)


def nearest(view_1, view_2, prior):  # each other's most similar descriptors
    similar = view_1.descriptors @ view_2.descriptors.mT
    similar = similar.masked_fill(~view_1.mask[:, None] | ~view_2.mask, -1.0)
    best, column = similar.max(1)
    rows = torch.arange(len(column))
    return Matches(
        rows[None], column[None], 1 - best[None], ((similar.argmax(0)[column] == rows) & (best > 0.8))[None]
    )
