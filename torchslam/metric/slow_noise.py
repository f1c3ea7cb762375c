"""Noise that scatters and wanders: covariances of several strengths and durations, and how well each explains data.

The errors of instruments and of a path that drifts are not independent. How strong and how slow they are is not known,
so results are averaged over a set of covariances by their restricted likelihoods (Harville, "Maximum likelihood
approaches to variance component estimation and to related problems", 1977).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.robust import fit_inliers, median_scale
from torchslam.metric.source import ScaleMeasurement, ScaleSource, Unmeasured

STRENGTHS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Standard deviations of slow noise, in those of white noise; beyond the last one the white noise does not matter."""
DURATIONS = (0.1, 0.3, 3.0)
"""After these parts of the recording the slow noise is forgotten; the last one is a walk without an end."""
GATE = 4.0  # standard deviations beyond which a value is wrong: 6e-5 of right ones are. Tried at 4 only
ROUNDS = 20  # rejections until nothing changes; two to four are usual
MAX_RELATIVE_STD = 0.25  # relative standard error from which on a scale is no measurement


def slow_correlations(
    times: Float[Tensor, " G"], durations: tuple[float, ...] = DURATIONS
) -> Float[Tensor, "B G G"]:
    """Covariances of slow noise in units of the variance of white noise; none at all is the first."""
    span = (times[-1] - times[0]).clamp_min(1e-9)
    apart = (times[:, None] - times).abs() / span
    pairs = [(0.0, 1.0), *((strength, duration) for strength in STRENGTHS for duration in durations)]
    strength, duration = torch.tensor(pairs, dtype=torch.float64, device="cpu").T[..., None, None]
    return strength.square() * torch.exp(-apart / duration)


class Averaged(NamedTuple):
    """Estimates of several models as one: their weights, and factors by which to multiply their covariances."""

    weights: Float[Tensor, " B"]
    variance_factors: Float[Tensor, " B"]

    def variance(self, values: Float[Tensor, " B"], variances: Float[Tensor, " B"]) -> Float[Tensor, ""]:
        """Variance of a value about its mean over the models, from each model's own, before its factor."""
        mean = (self.weights * values).sum()
        return (self.weights * (self.variance_factors * variances + (values - mean).square())).sum()


def averaged(
    log_determinants: Float[Tensor, " B"],
    information: Float[Tensor, "B P P"],
    chi_squares: Float[Tensor, " B"],
    freedom: int,
) -> Averaged:
    """Weights and variance factors of models, whose covariances are known up to a factor.

    Args:
        log_determinants: of the covariances of the values.
        information: of the estimated parameters, in the same coordinates for all models.
        chi_squares: of the residuals.
        freedom: number of values less the number of parameters, one or more.
    """
    log_likelihood = -0.5 * (log_determinants + torch.logdet(information) + freedom * chi_squares.log())
    # The variance of Student's distribution; with one or two degrees of freedom it has none.
    return Averaged(torch.softmax(log_likelihood, 0), chi_squares / max(freedom - 2, 1))


def group_rows(count: int) -> tuple[Tensor, Tensor]:
    """The group of each of `count` successive rows, and the sizes of groups: their means lose no slow noise."""
    groups = min(count, 120)
    group = torch.arange(count, device="cpu") * groups // count
    return group, torch.bincount(group, minlength=groups).double()


def group_means(values: Float[Tensor, "N ..."], group: Tensor, size: Tensor) -> Float[Tensor, "G ..."]:
    """Means of the groups."""
    total = torch.zeros(len(size), *values.shape[1:], dtype=values.dtype, device="cpu")
    return total.index_add(0, group, values) / size.view(-1, *(1,) * (values.ndim - 1))


class SlowMean(NamedTuple):
    """The mean of the values of a series that agree (inliers), its standard error, and their standard deviation."""

    mean: float
    std: float
    scatter: float
    inliers: Bool[Tensor, " N"]


def slow_mean(times: Float[Tensor, " N"], values: Float[Tensor, " N"], stds: Float[Tensor, " N"]) -> SlowMean:
    """The mean of three or more values at ascending times with white and slow noise, up to half of them wrong.

    Standard deviations are relative to each other.
    """

    def inliers_of(mean: Tensor) -> Tensor:
        whitened = (values - mean).abs() / stds
        return whitened <= GATE * median_scale(whitened).clamp_min(1e-9)  # rounding is no scatter

    def mean_of(_: Tensor, inliers: Tensor) -> Tensor:
        weights = inliers / stds.square()
        return (weights * values).sum() / weights.sum()

    # From the middle of the shortest interval with half of the values: wrong ones may all lie on one side.
    ordered, half = values.sort().values, len(values) // 2
    start = (ordered[half:] - ordered[: len(values) - half]).argmin()
    found = fit_inliers((ordered[start] + ordered[start + half]) / 2, inliers_of, mean_of, ROUNDS)
    assert found is not None  # a mean is always determined
    inliers = found[1]
    group, size = group_rows(int(inliers.sum()))
    kept, own = values[inliers], stds[inliers].square()
    white = group_means(own, group, size) / size
    at = group_means(times[inliers], group, size)
    # Noise that lasts as long as the recording is part of its mean.
    V = slow_correlations(at, DURATIONS[:2]) * own.mean() + torch.diag(white)
    L = torch.linalg.cholesky(V)
    y = torch.linalg.solve_triangular(
        L, group_means(kept, group, size).expand(len(V), -1)[..., None], upper=False
    )
    one = torch.linalg.solve_triangular(L, torch.ones_like(y), upper=False)
    information = (one * one).sum((1, 2))
    means = (one * y).sum((1, 2)) / information
    chi_squares = (y - means[:, None, None] * one).square().sum((1, 2)).clamp_min(1e-18)
    log_determinants = 2 * L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    models = averaged(log_determinants, information[:, None, None], chi_squares, len(size) - 1)
    return SlowMean(
        float((models.weights * means).sum()),
        float(models.variance(means, 1 / information).sqrt()),
        float(kept.std()),
        inliers,
    )


def scale_of_series(
    source: ScaleSource,
    times: Float[Tensor, " N"],
    logs: Float[Tensor, " N"],
    stds: Float[Tensor, " N"],
    unit: str,
    name_of: Callable[[int], str],
    *,
    disagreement: str,
    cause: str = "",
    shared_std: float = 0.0,
    notes: tuple[str, ...] = (),
) -> ScaleMeasurement | Unmeasured:
    """Average a series of logarithms of meters per unit, up to half of them wrong; see `slow_mean`.

    Args:
        name_of: the name of a row, such as "at 3.2 s".
        disagreement: message where they determine no scale, with `{}` for their relative standard deviation.
        cause: end of the message about rejected ones.
        shared_std: relative standard deviation of an error that all have in common.
    """
    mean = slow_mean(times, logs, stds)
    if mean.std > MAX_RELATIVE_STD or float(mean.inliers.double().mean()) < 0.5:
        return Unmeasured(source, disagreement.format(f"{mean.scatter:.0%}"))
    # Where all others agree, deviations below the shared error are many standard deviations.
    wrong = torch.nonzero(~mean.inliers & ((logs - mean.mean).abs() > shared_std))[:, 0]
    rejected = []
    if len(wrong):
        off = (logs[wrong] - mean.mean).exp() - 1
        rejected.append(
            f"{len(wrong)} of {len(logs)} {unit}, the first one {name_of(int(wrong[0]))}, are "
            f"{float(off.min()):+.0%} to {float(off.max()):+.0%} off{cause}"
        )
    return ScaleMeasurement(
        source,
        math.exp(mean.mean),
        max(math.hypot(mean.std, shared_std), 1e-6),
        int(mean.inliers.sum()),
        unit,
        tuple(rejected),
        apart=mean.scatter,
        notes=notes,
    )
