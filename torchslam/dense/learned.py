"""A small network on top of semi-global aggregation: depth where matching found a wrong one, and how certain it is.

It reads the image and the minima of the aggregated costs at half and at full size, in a U-net at half size, and gives
for each pixel a change of the depth and the probability that the depth is right. `examples/train_depth.py` trains it;
`experiments/dense/README.md` says what it gains.
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

LEAST_CHANGE = 1.0
"""Steps of the planes: a smaller change is not made, since the minimum is more precise than the network."""
WIDTHS = (24, 32, 36, 36)
"""Channels at half, quarter, eighth and sixteenth size."""
HALF_INPUTS, FULL_INPUTS = 7, 5
"""Inputs per pixel of half size, and per pixel of full size, of which four belong to one of half size."""
LARGEST_DETAIL = 4.0
"""Steps: differences of depth within a pixel of half size count up to this."""
_WEIGHTS_FILE = Path(__file__).parent / "learned.safetensors"


class DepthNet(nn.Module):
    """From inputs (B, 27, H / 2, W / 2) to changes of depth in steps and log-odds, (B, 4, H / 2, W / 2) each."""

    def __init__(self, widths: tuple[int, int, int, int] = WIDTHS) -> None:
        super().__init__()
        self.first = nn.Conv2d(HALF_INPUTS + 4 * FULL_INPUTS, widths[0], 1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in pairwise(widths))
        self.encode = nn.ModuleList(nn.Conv2d(each, each, 3, 1, 1) for each in widths)
        self.up = nn.ModuleList(nn.Conv2d(a + b, a, 1) for a, b in pairwise(widths))
        self.decode = nn.ModuleList(nn.Conv2d(each, each, 3, 1, 1) for each in widths[:-1])
        self.last = nn.Conv2d(widths[0], 8, 1)
        nn.init.zeros_(self.last.weight)  # before the training nothing changes, and all is as probable as not
        if self.last.bias is not None:
            nn.init.zeros_(self.last.bias)

    def forward(
        self, inputs: Float[Tensor, "B C h w"]
    ) -> tuple[Float[Tensor, "B 4 h w"], Float[Tensor, "B 4 h w"]]:
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
        change, log_odds = self.last(x).chunk(2, dim=1)
        return 4 * change, log_odds


@lru_cache(maxsize=4)
def trained_net(device: torch.device, dtype: torch.dtype = torch.float32) -> DepthNet:
    """The network of the package."""
    net = DepthNet()
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
        farthest, step = steps_of(found, near, far)
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
        detail = position - F.interpolate(middle, scale_factor=2)[:, 0]
        full = torch.stack(
            (
                gray - 0.5,
                _log_texture(gray),
                detail.clamp(-LARGEST_DETAIL, LARGEST_DETAIL),
                found.fine.cost,
                found.fine.margin,
            ),
            dim=1,
        )
        return torch.cat((*half, F.pixel_unshuffle(full, 2)), dim=1)


def changed_depth(
    inverse_depth: Float[Tensor, "B H W"],
    change: Float[Tensor, "B 4 h w"],
    farthest: Float[Tensor, "B 1 1"],
    step: Float[Tensor, "B 1 1"],
    least_change: float = LEAST_CHANGE,
) -> Float[Tensor, "B H W"]:
    """Inverse depth after the changes of the network; it stays positive.

    Differentiable; which changes are made is a decision.

    Args:
        inverse_depth: that was found.
        change: of the network, steps.
        farthest, step: by `steps_of`.
        least_change: smaller changes are not made; 0 in the training.
    """
    change = F.pixel_shuffle(change, 2)[:, 0]
    change = torch.where(change.abs() >= least_change, change, 0.0)
    return torch.maximum(inverse_depth + step * change, 0.5 * farthest)


def learned_depth(
    found: Estimate,
    gray: Float[Tensor, "B H W"],
    near: Float[Tensor, " B"],
    far: Float[Tensor, " B"],
    net: DepthNet | None = None,
) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
    """Improve depth found by `estimate_depth`.

    Args:
        found, gray, near, far: as for `net_inputs`.
        net: None: that of the package.

    Returns:
        Inverse depth, and the probability that it is right within 5 %.
    """
    net = trained_net(found.inverse_depth.device, found.inverse_depth.dtype) if net is None else net
    change, log_odds = net(net_inputs(found, gray, near, far))
    inverse_depth = changed_depth(found.inverse_depth, change, *steps_of(found, near, far))
    return inverse_depth, torch.sigmoid(F.pixel_shuffle(log_odds, 2)[:, 0])


def steps_of(
    found: Estimate, near: Tensor, far: Tensor
) -> tuple[Float[Tensor, "B 1 1"], Float[Tensor, "B 1 1"]]:
    """Least inverse depth of the planes of views and the step between them."""
    near, far = (each.to(found.inverse_depth)[:, None, None] for each in (near, far))
    return 1 / far, (1 / near - 1 / far) / (PLANES - 1)


def _log_texture(gray: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
    """Logarithm of the standard deviation in windows of five pixels, about -1 without texture to 1."""
    centered = gray - gray.mean((-1, -2), keepdim=True)
    count = box_sum(torch.ones_like(gray), 2)
    mean = box_sum(centered, 2) / count
    variance = box_sum(centered * centered, 2) / count - mean * mean
    return (variance.clamp(min=0).sqrt() + NOISE).log() / 2 + 1.5
