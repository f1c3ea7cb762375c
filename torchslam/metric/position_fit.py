"""The similarity from a map to positions that were measured from outside, with an error that can be believed.

The noise of a receiver wanders slowly, by as much as it scatters, and that bends and stretches a path; so does the
drift of the map. The fit is made for several covariances and averaged (`slow_noise`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.func import jacfwd

from torchslam.geometry import rigid, sim3_exp, sim3_scale, transform, umeyama
from torchslam.geometry.robust import NORMAL_MEDIAN_3D, fit_inliers
from torchslam.metric.slow_noise import GATE, averaged, group_means, group_rows, slow_correlations
from torchslam.optim import LEAST_SQUARES_OPTIONS, solve_least_squares

MIN_POSITIONS = 4
"""Fewer have no redundancy worth the name: three fix a similarity and leave two numbers over."""
SAMPLES = 512
"""Similarities of three positions each, of which the best is the start. With half of the positions wrong, 64 of
them are of right ones, and the best of many is near. Tried at 512 only."""
ROUNDS = 10
"""Fits of the start, each to the positions that the one before explains; they settle in two to four."""
CAMERA_UP_STD = 1.0
"""Radians: how far the cameras' up may be from the true one. A line leaves the turn about it to this; elsewhere, where
positions know their up to a degree, a camera that looks to the ground moves it by less than a hundredth of that."""
LEVEL = 0.05
"""Where heights were not measured the path is taken for level, with this part of its extent as standard deviation."""
CLOCK_STD = 0.3  # seconds by which two clocks of one device may differ, delays of a receiver included


@dataclass(frozen=True)
class PositionFit:
    """The similarity S_ew from a map to measured positions, and the relative standard error of its scale.

    Attributes:
        up_w, up_std: up in the map, a unit vector, and its standard error, radians.
        offset, offset_std: seconds that the clock of the images is ahead of that of the positions, beyond what was
            removed before, and its standard error.
        inliers: positions that agree.
        distances: of each position from the path, meters, by the coordinates that were measured.
        noise: standard deviations along one axis, horizontal and vertical, that the path leaves over, meters.
    """

    S_ew: Float[Tensor, "4 4"]
    relative_std: float
    up_w: Float[Tensor, " 3"]
    up_std: float
    offset: float
    offset_std: float
    inliers: Bool[Tensor, " N"]
    distances: Float[Tensor, " N"]
    noise: tuple[float, float]


@dataclass(frozen=True)
class PositionPairs:
    """N positions of the camera at ascending seconds, in the map and as they were measured.

    Attributes:
        velocities_w: units of the map per second, zero where the times of both are the same by construction.
        positions_e: as measured, meters: east, north, up.
        std: standard deviations, horizontal along one axis and vertical, meters; NaN if unknown.
        has_height: whether the third coordinate was measured.
    """

    times: Float[Tensor, " N"]
    positions_w: Float[Tensor, "N 3"]
    velocities_w: Float[Tensor, "N 3"]
    positions_e: Float[Tensor, "N 3"]
    std: Float[Tensor, "N 2"]
    has_height: Bool[Tensor, " N"]

    def __len__(self) -> int:
        return len(self.times)

    def select(self, rows: Bool[Tensor, " N"] | Int[Tensor, " M"]) -> PositionPairs:
        """Some of them."""
        return PositionPairs(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def fit_positions(pairs: PositionPairs, camera_up_w: Float[Tensor, " 3"]) -> PositionFit | None:
    """Fit a similarity to `MIN_POSITIONS` or more, up to half of them wrong; None where they do not determine one.

    `camera_up_w` is the mean direction in the map that is up in the images, a unit vector.
    """

    def residuals_of(S_ew: Tensor) -> Float[Tensor, "N 3"]:
        return pairs.positions_e - transform(S_ew, pairs.positions_w)

    def inliers_of(model: _Model) -> Bool[Tensor, " N"]:
        return ((residuals_of(model.S_ew).abs() <= GATE * model.stds) | ~_known(pairs)).all(-1)

    def averaged_from(model: _Model, inliers: Bool[Tensor, " N"], slow: bool) -> PositionFit | None:
        return _average(pairs, inliers, model, camera_up_w, slow)

    def fitted(model: _Model, inliers: Bool[Tensor, " N"]) -> _Model | None:
        if int(inliers.sum()) < MIN_POSITIONS:
            return None
        model = _Model(model.S_ew, _scatter(residuals_of(model.S_ew), inliers, pairs))
        fit = averaged_from(model, inliers, slow=False)
        return None if fit is None else _Model(fit.S_ew, model.stds)

    found = fit_inliers(_robust_start(pairs), inliers_of, fitted, ROUNDS)
    return None if found is None else averaged_from(*found, slow=True)


def start_distance(pairs: PositionPairs) -> float:
    """Standard deviation of the positions about the similarity that fits half of them best, meters."""
    return float(_robust_start(pairs).stds[0, 0])


def _known(pairs: PositionPairs) -> Bool[Tensor, "N 3"]:
    """Which coordinates were measured."""
    known = torch.ones_like(pairs.positions_e, dtype=torch.bool)
    known[:, 2] = pairs.has_height
    return known


class _Model(NamedTuple):
    """A similarity, and standard deviations of the positions about it along the axes."""

    S_ew: Float[Tensor, "4 4"]
    stds: Float[Tensor, "N 3"]


def _robust_start(pairs: PositionPairs) -> _Model:
    """The similarity of three positions with the least median of distances, and standard deviations.

    Source: Rousseeuw, "Least median of squares regression", 1984.
    """
    generator = torch.Generator(device="cpu").manual_seed(0)
    keys = torch.rand(SAMPLES, len(pairs), generator=generator, dtype=torch.float64, device="cpu")
    sample = keys.topk(3, dim=1).indices
    s, R, t = umeyama(pairs.positions_w[sample], pairs.positions_e[sample])
    moved = s[:, None, None] * pairs.positions_w @ R.mT + t[:, None]
    distances = torch.where(_known(pairs), pairs.positions_e - moved, 0.0).norm(dim=-1)
    half = distances.kthvalue((len(pairs) + 4) // 2, dim=1).values.nan_to_num(torch.inf)
    best = int(half.argmin())
    # Few positions are overfitted.
    std = half[best] / NORMAL_MEDIAN_3D * (1 + 5 / max(len(pairs) - 3, 1))
    return _Model(rigid(s[best] * R[best], t[best]), std.clamp_min(1e-3).expand(len(pairs), 3))


def _scatter(
    residuals: Float[Tensor, "N 3"], inliers: Bool[Tensor, " N"], pairs: PositionPairs
) -> Float[Tensor, "N 3"]:
    """Standard deviations along the axes: the stated ones, scaled by the residuals."""
    known = _known(pairs) & inliers[:, None]
    stated = torch.cat((pairs.std[:, :1].expand(-1, 2), pairs.std[:, 1:]), dim=-1)
    typical = stated.nanmedian(0).values
    stated = torch.where(stated.isnan(), torch.where(typical.isnan(), 1.0, typical), stated)
    squared = torch.where(known, (residuals / stated).square(), 0.0)
    shared = torch.stack((squared[:, :2].sum(), squared[:, :2].sum(), squared[:, 2].sum()))
    count = torch.stack((known[:, :2].sum(), known[:, :2].sum(), known[:, 2].sum()))
    freedom = (count - torch.tensor((4.0, 4.0, 2.0), dtype=torch.float64, device="cpu")).clamp_min(1.0)
    factor = (shared / freedom).sqrt()
    factor[2] = torch.where(count[2] > 0, factor[2].clamp(factor[0] / 10, 10 * factor[0]), factor[0])
    return (factor * stated).clamp_min(1e-3)


def _average(
    pairs: PositionPairs,
    inliers: Bool[Tensor, " N"],
    start: _Model,
    camera_up_w: Float[Tensor, " 3"],
    slow: bool,
) -> PositionFit | None:
    """The average over all covariances, or white noise alone; None where one does not determine the similarity."""
    kept, stds = pairs.select(inliers), start.stds[inliers]
    # A similarity of averages is the average of similar points, so that nothing is lost but fast changes.
    group, size = group_rows(len(kept))

    def mean(values: Tensor) -> Tensor:
        return group_means(values, group, size)

    extent = (kept.positions_e.amax(0) - kept.positions_e.amin(0))[:2].norm()
    white = mean(stds.square()) / size[:, None]
    white[:, 2] += ((mean((~kept.has_height).double()) > 0) * LEVEL * extent).square()
    # Every receiver wanders: white noise alone is for the rounds that reject, where it is good enough.
    correlations = slow_correlations(mean(kept.times))[slice(1, None) if slow else slice(1)]
    V = correlations[:, None] * stds.square().mean(0)[:, None, None] + torch.diag_embed(white.mT)
    L = torch.linalg.cholesky(V)
    eye = torch.eye(len(size), dtype=torch.float64, device="cpu")
    whitening = torch.linalg.solve_triangular(L, eye.expand_as(L), upper=False)
    B = len(correlations)
    shared = (mean(kept.positions_w), mean(kept.velocities_w), mean(kept.positions_e), camera_up_w)
    inputs = (whitening, *(x.expand(B, *x.shape) for x in shared))
    solution = solve_least_squares(
        _residuals,
        (start.S_ew.expand(B, 4, 4), eye.new_zeros(B, 1)),
        inputs,
        ("sim3", "euclidean"),
        options=LEAST_SQUARES_OPTIONS.replace(tolerance=1e-6),  # a thousandth of a standard error
    )
    if not bool(solution.success.all()):
        return None
    S, offset = solution.unknowns

    def moved(step: Float[Tensor, " 8"]) -> Float[Tensor, "B N"]:
        return _residuals(sim3_exp(step[:7]) @ S, offset + step[7], *inputs)

    J = jacfwd(moved)(eye.new_zeros(8))  # translation, rotation, log scale, offset
    information = J.mT @ J
    log_det = 2 * L.diagonal(dim1=-2, dim2=-1).log().sum((-1, -2))
    models = averaged(log_det, information, 2 * solution.cost, 3 * len(size) - 7)
    covariance = torch.linalg.inv(information)
    log_scale, best = sim3_scale(S).log(), int(models.weights.argmax())
    tilt = ((models.weights * models.variance_factors)[:, None, None] * covariance[:, 3:5, 3:5]).sum(0)
    # The best similarity, with the mean scale about the middle of the path.
    S_ew, center_w = S[best].clone(), shared[0].mean(0, keepdim=True)
    center_e = transform(S_ew, center_w)[0]
    S_ew[:3, :3] *= ((models.weights * log_scale).sum() - log_scale[best]).exp()
    S_ew[:3, 3] = center_e - S_ew[:3, :3] @ center_w[0]
    delay = (models.weights * offset[:, 0]).sum()
    left = pairs.positions_e - transform(S_ew, pairs.positions_w + delay * pairs.velocities_w)
    left = torch.where(_known(pairs), left, 0.0)
    squared = left[inliers].square().mean(0)
    return PositionFit(
        S_ew,
        float(models.variance(log_scale, covariance[:, 6, 6]).sqrt()),
        S_ew[2, :3] / S_ew[2, :3].norm(),
        float(torch.linalg.eigvalsh(tilt)[-1].sqrt()),
        float(delay),
        float(models.variance(offset[:, 0], covariance[:, 7, 7]).sqrt()),
        inliers,
        left.norm(dim=-1),
        (float(squared[:2].mean().sqrt()), float(squared[2].sqrt())),
    )


def _residuals(
    S_ew: Float[Tensor, "B 4 4"],
    offset: Float[Tensor, "B 1"],
    whitening: Float[Tensor, "B 3 G G"],
    positions_w: Float[Tensor, "B G 3"],
    velocities_w: Float[Tensor, "B G 3"],
    positions_e: Float[Tensor, "B G 3"],
    camera_up_w: Float[Tensor, "B 3"],
) -> Float[Tensor, "B N"]:
    """Whitened differences of positions, then of the clocks, then of the cameras' up; for `solve_least_squares`."""
    moved = transform(S_ew, positions_w + offset[..., None] * velocities_w)
    errors = (whitening @ (moved - positions_e).mT[..., None]).squeeze(-1)
    up = torch.nn.functional.normalize((S_ew[..., :3, :3] @ camera_up_w[..., None]).squeeze(-1), dim=-1)
    up = up - torch.tensor((0.0, 0.0, 1.0), dtype=up.dtype, device=up.device)
    return torch.cat((errors.flatten(-2), offset / CLOCK_STD, up / CAMERA_UP_STD), dim=-1)
