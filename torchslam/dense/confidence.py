"""How probable it is that a depth is right within 5 %: logistic models of what the estimation found.

The constants are those of largest likelihood on the sensor's depth of a handheld indoor recording and on the exact
depth of a rendered room, of equal weight; `experiments/dense/README.md` has their accuracy.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.dense.consistency import Merged
from torchslam.dense.estimate import Estimate

ALONE = (-1.67, 7.88, -1.03, 2.27, 0.97)
"""Weights of the cost and the margin at full size, of those at half size, and the constant."""
TOGETHER = (1.15, -0.66, -0.45, 0.40, 0.68)
"""Weights of the logarithm of the support, of the relative spread in percent, of the conflicts and of the view's own
log-odds where it agrees, and the constant."""
LEAST_SUPPORT = 1e-3
"""Least support that counts, as `LEAST_ALONE`."""
LEAST_ALONE = 1e-4
"""Below these, evidence does not count any further."""
LEAST_KEPT = 0.72
"""Least confidence of depth that is kept: then about nine in ten of all kept pixels are right."""
SPECK = 2
"""Radius of the neighborhood most of which must be kept, pixels."""


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


def kept(confidence: Float[Tensor, "H W"], least: float = LEAST_KEPT) -> Bool[Tensor, "H W"]:
    """Whether depth is kept: it is probable enough, and so is most of what is around it, which specks are not."""
    is_probable = confidence >= least
    share = F.avg_pool2d(is_probable.to(confidence.dtype)[None, None], 2 * SPECK + 1, 1, SPECK)[0, 0]
    return is_probable & (share > 0.5)


def _logistic(features: Tensor, weights: tuple[float, ...]) -> Tensor:
    slope = torch.tensor(weights[:-1], dtype=features.dtype, device=features.device)
    return torch.sigmoid(features @ slope + weights[-1])
