"""A small network that rates depth: how probable it is that what semi-global aggregation found is right.

It reads the image and the minima of the aggregated costs at half and at full size, in a U-net at half size.
`examples/train_depth.py` trains it; `experiments/dense/README.md` has its gain.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn

from torchslam.dense.cost_volume import NOISE, box_sum
from torchslam.dense.estimate import PLANES, Estimate

WIDTHS = (24, 32, 36, 36)
"""Channels at half, quarter, eighth and sixteenth size."""
HALF_INPUTS, FULL_INPUTS = 7, 5
"""Inputs per pixel of half size, and per pixel of full size, of which four belong to one of half size."""
LARGEST_DETAIL = 4.0
"""Steps: differences of depth within a pixel of half size count up to this."""
_WEIGHTS_FILE = Path(__file__).parent / "learned.safetensors"


class RatingNet(nn.Module):
    """From inputs (B, 27, H / 2, W / 2) to the log-odds of the four pixels of each, (B, 4, H / 2, W / 2)."""

    def __init__(self, widths: tuple[int, int, int, int] = WIDTHS) -> None:
        super().__init__()
        self.first = nn.Conv2d(HALF_INPUTS + 4 * FULL_INPUTS, widths[0], 1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in pairwise(widths))
        self.encode = nn.ModuleList(nn.Conv2d(each, each, 3, 1, 1) for each in widths)
        self.up = nn.ModuleList(nn.Conv2d(a + b, a, 1) for a, b in pairwise(widths))
        self.decode = nn.ModuleList(nn.Conv2d(each, each, 3, 1, 1) for each in widths[:-1])
        self.last = nn.Conv2d(widths[0], 4, 1)
        nn.init.zeros_(self.last.weight)  # before the training all is as probable as not
        if self.last.bias is not None:
            nn.init.zeros_(self.last.bias)

    def forward(self, inputs: Float[Tensor, "B C h w"]) -> Float[Tensor, "B 4 h w"]:
        x = F.relu(self.first(inputs))
        skipped = []
        for level, encode in enumerate(self.encode):
            if level > 0:
                skipped.append(x)
                x = F.relu(self.down[level - 1](x))
            x = F.relu(x + encode(x))
        for up, decode in zip(reversed(self.up), reversed(self.decode), strict=True):
            skip = skipped.pop()
            x = F.interpolate(x, size=skip.shape[-2:], mode="bilinear")
            x = F.relu(up(torch.cat((skip, x), dim=1)))
            x = F.relu(x + decode(x))
        log_odds: Tensor = self.last(x)
        return log_odds


@lru_cache(maxsize=4)
def trained_net(device: torch.device, dtype: torch.dtype = torch.float32) -> RatingNet:
    """The network of the package."""
    with torch.device("cpu"):
        net = RatingNet()
    net.load_state_dict(load_file(_WEIGHTS_FILE))
    return net.to(device, dtype).requires_grad_(False)


def net_inputs(
    found: Estimate, gray: Float[Tensor, "B H W"], near: Float[Tensor, " B"], far: Float[Tensor, " B"]
) -> Float[Tensor, "B C h w"]:
    """What the network reads: of even width and height; without a gradient.

    Args:
        found: by `estimate_depth` with PLANES planes.
        gray: reference images in [0, 1].
        near, far: range of depth, map units.
    """
    with torch.no_grad():
        near, far = (each.to(found.inverse_depth)[:, None, None] for each in (near, far))
        farthest, step = 1 / far, (1 / near - 1 / far) / (PLANES - 1)  # of the planes, in inverse depth
        position = (found.inverse_depth - farthest) / step
        coarse = torch.stack((*found.coarse, found.match), dim=1)[..., ::2, ::2]
        middle = F.avg_pool2d(position[:, None], 2)
        position_coarse, cost, curvature, margin, match = coarse.split(1, dim=1)
        relative = (middle + farthest[:, None] / step[:, None]).clamp(min=0.1).log()
        half = (
            2 * middle / PLANES - 1,
            cost,
            margin,
            curvature,
            match,
            relative / 4,
            (middle - position_coarse).clamp(-LARGEST_DETAIL, LARGEST_DETAIL),
        )
        centered = gray - gray.mean((-1, -2), keepdim=True)
        count = box_sum(torch.ones_like(gray), 2)
        mean = box_sum(centered, 2) / count
        variance = box_sum(centered * centered, 2) / count - mean * mean
        detail = position - F.interpolate(middle, scale_factor=2)[:, 0]
        full = torch.stack(
            (
                gray - 0.5,
                # Logarithm of the standard deviation in windows of five pixels, about -1 without texture to 1.
                (variance.clamp(min=0).sqrt() + NOISE).log() / 2 + 1.5,
                detail.clamp(-LARGEST_DETAIL, LARGEST_DETAIL),
                found.fine.cost,
                found.fine.margin,
            ),
            dim=1,
        )
        return torch.cat((*half, F.pixel_unshuffle(full, 2)), dim=1)


def learned_confidence(
    found: Estimate,
    gray: Float[Tensor, "B H W"],
    near: Float[Tensor, " B"],
    far: Float[Tensor, " B"],
    net: RatingNet | None = None,
) -> Float[Tensor, "B H W"]:
    """Probability that depth found by `estimate_depth` is right within 5 %, in place of `confidence_alone`.

    Args:
        found, gray, near, far: as for `net_inputs`.
        net: None: that of the package.
    """
    net = trained_net(found.inverse_depth.device, found.inverse_depth.dtype) if net is None else net
    return torch.sigmoid(F.pixel_shuffle(net(net_inputs(found, gray, near, far)), 2)[:, 0])
