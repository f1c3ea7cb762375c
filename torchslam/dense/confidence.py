"""How probable it is that a depth is right within 5 %: logistic models of what the estimation found.

The constants are those of largest likelihood on the sensor's depth of a handheld indoor recording and on the exact
depth of a rendered room, of equal weight; `experiments/dense` fits them.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.dense.consistency import Merged
from torchslam.dense.estimate import Estimate

ALONE = (-1.1, 6.4, -1.1, 2.0, 0.7)
"""Weights of the cost and the margin at full size, of those at half size, and the constant."""
TOGETHER = (2.4, -0.8, -0.3, 0.5, -1.0)
"""Weights of the logarithm of the support, of the relative spread in percent, of the conflicts and of the view's own
log-odds where it agrees, and the constant."""
LEAST_SUPPORT = 1e-3
LEAST_ALONE = 1e-4
"""Below these, evidence does not count any further."""


def alone_features(found: Estimate) -> Float[Tensor, "B H W 4"]:
    """What a view alone knows: cost and margin of the two minima."""
    return torch.stack((found.fine.cost, found.fine.margin, found.coarse.cost, found.coarse.margin), dim=-1)


def confidence_alone(found: Estimate) -> Float[Tensor, "B H W"]:
    """Probability that the depth of a view is right, before it is compared with others."""
    return _logistic(alone_features(found), ALONE)


def together_features(merged: Merged, alone: Float[Tensor, "H W"]) -> Float[Tensor, "H W 4"]:
    """What the comparison of the views adds."""
    own = merged.agrees * torch.logit(alone, LEAST_ALONE)
    support = merged.support.clamp(min=LEAST_SUPPORT).log()
    return torch.stack((support, 100 * merged.spread, merged.conflicts, own), dim=-1)


def confidence_together(merged: Merged, alone: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Probability that merged depth is right; 0 where there is none."""
    return torch.where(merged.inverse_depth > 0, _logistic(together_features(merged, alone), TOGETHER), 0.0)


def _logistic(features: Tensor, weights: tuple[float, ...]) -> Tensor:
    slope = torch.tensor(weights[:-1], dtype=features.dtype, device=features.device)
    return torch.sigmoid(features @ slope + weights[-1])
