"""What the networks that weigh matches have in common: their layers, and what is said of neighbours."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class InContext(nn.Module):
    """A number for each match from its cues, the match seen beside the mean of its problem; zero at first."""

    def __init__(self, num_cues: int, width: int, seed: int) -> None:
        super().__init__()
        self.local = nn.Linear(num_cues, width, dtype=torch.float64)
        self.mixed = nn.Linear(2 * width, width, dtype=torch.float64)
        self.last = nn.Linear(width, 1, dtype=torch.float64)
        generator = torch.Generator().manual_seed(seed)
        for layer in (self.local, self.mixed):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def numbers(self, cues: Tensor, mask: Tensor) -> Tensor:
        """(P, N, C), (P, N) -> (P, N), of any size; what is masked counts for no other match."""
        hidden = nn.functional.silu(self.local(cues))
        rows = mask[..., None].to(hidden.dtype)
        context = (hidden * rows).sum(1, keepdim=True) / rows.sum(1, keepdim=True).clamp_min(1)
        hidden = nn.functional.silu(self.mixed(torch.cat([hidden, context.expand_as(hidden)], -1)))
        return self.last(hidden)[..., 0]


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """(P, 1) median of the masked entries of (P, N), NaN where there are none."""
    return values.masked_fill(~mask, torch.nan).nanmedian(-1, keepdim=True).values


def crowd_and_support(
    positions: Tensor, radius: Tensor | float, inliers: Tensor, mask: Tensor
) -> tuple[Tensor, Tensor]:
    """(P, N) logarithm of the number of matches nearby over its mean, and the share of inliers among the others.

    Errors of neighbours are alike: their points were made from the same frames, and move with the same objects.

    positions: (P, N, 2); radius: of what is nearby in their units, one or (P, 1, 1); inliers, mask: (P, N) bool
    """
    near = ((torch.cdist(positions, positions) < radius) & mask[:, None, :]).to(positions.dtype)
    count = near.sum(-1).clamp_min(1)
    rows = mask.to(positions.dtype)
    crowd = (count * rows.sum(-1, keepdim=True) / (count * rows).sum(-1, keepdim=True).clamp_min(1)).log()
    agree = (near @ inliers[..., None].to(positions.dtype))[..., 0] - inliers.to(positions.dtype)
    return crowd, (agree + 0.5) / count
