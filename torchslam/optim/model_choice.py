"""Choose between two explanations of the same observations by how well they predict what neither was fitted to.

Both are estimated without a held-out share of the observations. For each held-out one, the logarithms of its likelihood
under either explanation are compared. Errors of neighbors are alike, so the sum counts with the scatter of stretches of
the recording, not of single observations; the scatter of few stretches is uncertain, which Student's t accounts for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

STRETCHES = 10
"""Stretches of a recording whose gains are compared. Tried at this value only."""
LEAST_GAIN, LEAST_UPDATE = 30.0, 5.0
"""Logarithm of the likelihood ratio from which on a change of a model with few parameters is believed: of a given
model, and of a guess or an estimate from fewer observations. In the tuning half of experiments/decisions, global
shutters gain up to 9 (up to 22 in whole runs of kitti07), rolling ones of 12 ms and more mostly over 40; exact cameras
of rendered sequences gain up to 9 but for one, those off by 3 % and more at least 43 but for one. Observations count
as independent, which they are not: with independent ones 5 would do for either."""
SURE = 3.0
"""Standard deviations, of a normal distribution with the same probability, from which on a gain counts where two maps
are compared, which differ in many parameters."""


@dataclass(frozen=True)
class Gain:
    """How much better one explanation predicts held-out observations than another.

    Attributes:
        total: difference of the log likelihoods of all of them; positive: the first explanation is the better one.
        std: standard error of `total` by the scatter of stretches; infinite with fewer than two.
        stretches: number of stretches with observations.
    """

    total: float
    std: float
    stretches: int

    @property
    def sigmas(self) -> float:
        """`total` in standard deviations of a normal distribution that are as improbable as its t statistic."""
        if not math.isfinite(self.std):
            return 0.0
        if self.std == 0.0:
            return math.copysign(math.inf, self.total) if self.total else 0.0
        t, degrees = self.total / self.std, self.stretches - 1
        # Wallace, "Bounds on normal approximations to Student's and the chi-square distributions", 1959.
        exact = math.sqrt(degrees * math.log1p(t * t / degrees)) * (8 * degrees + 1) / (8 * degrees + 3)
        return math.copysign(exact, t)

    @property
    def is_sure(self) -> bool:
        """Whether the first explanation is better by its scatter, where it has many more parameters."""
        return self.sigmas > SURE

    def is_worth(self, is_given: bool = True) -> bool:
        """Whether the first explanation, with a few more parameters, is the better one.

        is_given: whether the second one is a given one, neither a guess nor an estimate
        """
        return self.total > (LEAST_GAIN if is_given else LEAST_UPDATE)

    @classmethod
    def of_stretches(cls, sums: Float[Tensor, " G"]) -> Gain:
        """The gain by the sums of its stretches."""
        count, total = len(sums), float(sums.sum())
        if count < 2:
            return cls(total, math.inf, count)
        scatter = (sums - sums.mean()).square().sum() * count / (count - 1)
        return cls(total, float(scatter.sqrt()), count)


def predictive_gain(
    first: Float[Tensor, " N"], second: Float[Tensor, " N"], when: Shaped[Tensor, " N"]
) -> Gain:
    """Compare two explanations by their log likelihoods of held-out observations.

    Args:
        first: log likelihood of each observation under the first explanation.
        second: the same under the second one.
        when: numbers that order the observations in time.
    """
    differences = (first - second).double()
    place = torch.argsort(torch.argsort(when, stable=True), stable=True)
    count = max(1, min(STRETCHES, len(differences)))
    stretch = place * count // max(len(differences), 1)
    return Gain.of_stretches(differences.new_zeros(count).index_add(0, stretch, differences))
