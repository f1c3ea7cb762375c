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

from torchslam.geometry import rigid, sim3_scale, skew, transform, umeyama
from torchslam.geometry.robust import NORMAL_MEDIAN_3D, fit_inliers
from torchslam.metric.slow_noise import averaged, group_means, group_rows, slow_correlations
from torchslam.optim import LEAST_SQUARES_OPTIONS, solve_least_squares

MIN_POSITIONS = 4
"""Fewer have no redundancy worth the name: three fix a similarity and leave two numbers over."""
SAMPLES = 512
"""Similarities of three positions each, of which the best is the start. With half of the positions wrong, 64 of
them are of right ones, and the best of many is near. Tried at 512 only."""
SEED = 0  # of the samples
GATE = 4.0
"""Standard deviations of a position along one axis beyond which it is wrong: 2e-4 of right ones are.
Tried at 4 only."""
ROUNDS = 10
"""Fits of the start, each to the positions that the one before explains; they settle in two to four."""
TOLERANCE = 1e-6
"""Relative change of the cost at which a fit ends: a thousandth of a standard error."""
CAMERA_UP_STD = 1.0
"""Radians: how far the cameras' up may be from the true one. A line leaves the turn about it to this; elsewhere, where
positions know their up to a degree, a camera that looks to the ground moves it by less than a hundredth of that."""
CLOCK_STD = 0.3
"""Seconds by which two clocks of one device may differ, delays of a receiver included."""


@dataclass(frozen=True)
class PositionFit:
    """The similarity from a map to measured positions.

    Attributes:
        S_ew: from the map to the frame of the positions.
        relative_std: relative standard error of the scale.
        up_w: up in the map, a unit vector.
        up_std: its standard error, radians.
        offset: seconds that the clock of the images is ahead of that of the positions, beyond what was removed before.
        offset_std: its standard error.
        inliers: positions that agree.
        residuals: of each position from the path, meters, zero where a coordinate was not measured.
        noise: standard deviations along one axis, horizontal and vertical, that the path leaves over, meters.
    """

    S_ew: Float[Tensor, "4 4"]
    relative_std: float
    up_w: Float[Tensor, " 3"]
    up_std: float
    offset: float
    offset_std: float
    inliers: Bool[Tensor, " N"]
    residuals: Float[Tensor, "N 3"]
    noise: tuple[float, float]

    @property
    def distances(self) -> Float[Tensor, " N"]:
        """Of each position from the path, meters."""
        return self.residuals.norm(dim=-1)


@dataclass(frozen=True)
class PositionPairs:
    """N positions of the camera in the map and as they were measured.

    Attributes:
        times: seconds, ascending.
        positions_w: in the map.
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


def fit_positions(
    pairs: PositionPairs, camera_up_w: Float[Tensor, " 3"], clock_std: float = CLOCK_STD
) -> PositionFit | None:
    """Fit a similarity to positions, up to half of them wrong; None where they do not determine one.

    Args:
        pairs: `MIN_POSITIONS` or more.
        camera_up_w: mean direction in the map that is up in the images, a unit vector.
        clock_std: standard deviation of the difference of the clocks, seconds.
    """

    def residuals_of(S_ew: Tensor) -> Float[Tensor, "N 3"]:
        return pairs.positions_e - transform(S_ew, pairs.positions_w)

    def inliers_of(model: _Model) -> Bool[Tensor, " N"]:
        return ((residuals_of(model.S_ew).abs() <= GATE * model.stds) | ~_known(pairs)).all(-1)

    def fitted(model: _Model, inliers: Bool[Tensor, " N"]) -> _Model | None:
        if int(inliers.sum()) < MIN_POSITIONS:
            return None
        stds = _scatter(residuals_of(model.S_ew), inliers, pairs)
        kept = _grouped(pairs.select(inliers), stds[inliers])
        fit = _average(kept, model.S_ew, camera_up_w, clock_std, slow=False)
        return None if fit is None else _Model(fit.S_ew, stds)

    found = fit_inliers(_robust_start(pairs), inliers_of, fitted, ROUNDS)
    if found is None:
        return None
    (S_ew, stds), inliers = found
    kept = _grouped(pairs.select(inliers), stds[inliers])
    fit = _average(kept, S_ew, camera_up_w, clock_std, slow=True)
    if fit is None:
        return None
    S_ew = fit.S_ew
    moved = pairs.positions_w + fit.offset * pairs.velocities_w
    residuals = pairs.positions_e - transform(S_ew, moved)
    residuals = torch.where(_known(pairs), residuals, 0.0)
    left = residuals[inliers].square().mean(0)
    noise = float((0.5 * (left[0] + left[1])).sqrt()), float(left[2].sqrt())
    return PositionFit(
        S_ew, fit.relative_std, fit.up_w, fit.up_std, fit.offset, fit.offset_std, inliers,
        residuals, noise,
    )  # fmt: skip


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
    generator = torch.Generator(device="cpu").manual_seed(SEED)
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


@dataclass(frozen=True)
class _Groups:
    """Averages of successive positions, with standard deviations of their white noise along the axes."""

    times: Float[Tensor, " G"]
    positions_w: Float[Tensor, "G 3"]
    velocities_w: Float[Tensor, "G 3"]
    positions_e: Float[Tensor, "G 3"]
    white: Float[Tensor, "G 3"]
    single: Float[Tensor, " 3"]


def _grouped(pairs: PositionPairs, stds: Float[Tensor, "N 3"]) -> _Groups:
    """A similarity of averages is the average of similar points, so that nothing is lost but fast changes."""
    group, size = group_rows(len(pairs))

    def mean(values: Tensor) -> Tensor:
        return group_means(values, group, size)

    white = (mean(stds.square()) / size[:, None]).sqrt()
    extent = (pairs.positions_e.amax(0) - pairs.positions_e.amin(0))[:2].norm()
    level = (mean((~pairs.has_height).double()) > 0) * LEVEL * extent
    white[:, 2] = (white[:, 2].square() + level.square()).sqrt()
    return _Groups(
        mean(pairs.times),
        mean(pairs.positions_w),
        mean(pairs.velocities_w),
        mean(pairs.positions_e),
        white,
        stds.square().mean(0).sqrt(),
    )


LEVEL = 0.05
"""Where heights were not measured the path is taken for level, with this part of its extent as standard deviation."""


@dataclass(frozen=True)
class _Averaged:
    S_ew: Float[Tensor, "4 4"]
    relative_std: float
    up_w: Float[Tensor, " 3"]
    up_std: float
    offset: float
    offset_std: float


def _average(
    groups: _Groups,
    start: Float[Tensor, "4 4"],
    camera_up_w: Float[Tensor, " 3"],
    clock_std: float,
    slow: bool,
) -> _Averaged | None:
    """The average over all covariances, or white noise alone; None where one does not determine the similarity."""
    # Every receiver wanders: white noise alone is for the rounds that reject, where it is good enough.
    correlations = slow_correlations(groups.times)[slice(1, None) if slow else slice(1)]
    B = len(correlations)
    whitening, log_det = [], torch.zeros(B, dtype=torch.float64, device="cpu")
    eye = torch.eye(len(groups.times), dtype=torch.float64, device="cpu")
    for axis in range(3):
        V = correlations * groups.single[axis].square() + torch.diag(groups.white[:, axis].square())
        L = torch.linalg.cholesky(V)
        whitening.append(torch.linalg.solve_triangular(L, eye.expand_as(L), upper=False))
        log_det = log_det + 2 * L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    W = torch.stack(whitening, dim=1)  # (B, 3, G, G)
    same = (groups.positions_w, groups.velocities_w, groups.positions_e, camera_up_w)
    inputs = (
        W,
        *(x.expand(B, *x.shape) for x in same),
        torch.full((B,), clock_std, dtype=torch.float64, device="cpu"),
    )
    solution = solve_least_squares(
        position_residuals,
        (start.expand(B, 4, 4), torch.zeros(B, 1, dtype=torch.float64, device="cpu")),
        inputs,
        ("sim3", "euclidean"),
        options=LEAST_SQUARES_OPTIONS.replace(tolerance=TOLERANCE),
    )
    if not bool(solution.success.all()):
        return None
    S, offset = solution.unknowns
    r = position_residuals(S, offset, *inputs)
    J = _jacobian(S, offset, *inputs)
    information = J.mT @ J
    models = averaged(log_det, information, r.square().sum(-1), 3 * len(groups.times) - 7)
    weights = models.weights
    covariance = torch.linalg.inv(information)
    log_scale = sim3_scale(S).log()
    mean, delay = (weights * log_scale).sum(), (weights * offset[:, 0]).sum()
    best = int(weights.argmax())
    tilt = ((weights * models.variance_factors)[:, None, None] * covariance[:, 3:5, 3:5]).sum(0)
    center_w = groups.positions_w.mean(0)
    S_ew = _rescaled(S[best], center_w, (mean - log_scale[best]).exp())
    up_w = S_ew[2, :3] / S_ew[2, :3].norm()
    return _Averaged(
        S_ew,
        float(models.variance(log_scale, covariance[:, 6, 6]).sqrt()),
        up_w,
        float(torch.linalg.eigvalsh(tilt)[-1].sqrt()),
        float(delay),
        float(models.variance(offset[:, 0], covariance[:, 7, 7]).sqrt()),
    )


def position_residuals(
    S_ew: Float[Tensor, "B 4 4"],
    offset: Float[Tensor, "B 1"],
    whitening: Float[Tensor, "B 3 G G"],
    positions_w: Float[Tensor, "B G 3"],
    velocities_w: Float[Tensor, "B G 3"],
    positions_e: Float[Tensor, "B G 3"],
    camera_up_w: Float[Tensor, "B 3"],
    clock_std: Float[Tensor, " B"],
) -> Float[Tensor, "B N"]:
    """Whitened differences of positions, then of the clocks, then of the cameras' up; for `solve_least_squares`.

    Args:
        S_ew: from the map to the frame of the positions.
        offset: seconds that the clock of the images is ahead.
        whitening: of the errors along each axis.
        positions_w: in the map.
        velocities_w: units of the map per second.
        positions_e: as measured.
        camera_up_w: mean direction in the map that is up in the images.
        clock_std: seconds.
    """
    moved = transform(S_ew, positions_w + offset[..., None] * velocities_w)
    errors = (whitening @ (moved - positions_e).mT[..., None]).squeeze(-1)
    up = (S_ew[..., :3, :3] @ camera_up_w[..., None]).squeeze(-1)
    up = up / up.norm(dim=-1, keepdim=True)
    up = up - torch.tensor((0.0, 0.0, 1.0), dtype=up.dtype, device=up.device)
    return torch.cat((errors.flatten(-2), offset / clock_std[..., None], up / CAMERA_UP_STD), dim=-1)


def _jacobian(
    S_ew: Tensor,
    offset: Tensor,
    whitening: Tensor,
    positions_w: Tensor,
    velocities_w: Tensor,
    positions_e: Tensor,
    camera_up_w: Tensor,
    clock_std: Tensor,
) -> Float[Tensor, "B N 8"]:
    """Of `position_residuals` in a left perturbation of S_ew (translation, rotation, log scale), then the offset."""
    moved = transform(S_ew, positions_w + offset[..., None] * velocities_w)
    center = moved.mean(-2, keepdim=True)  # a turn about the middle, for well-conditioned information
    arm = moved - center
    eye = torch.eye(3, dtype=moved.dtype, device=moved.device).expand(*moved.shape, 3)
    velocity = velocities_w @ S_ew[..., :3, :3].mT
    J = torch.cat((eye, -skew(arm), arm[..., None], velocity[..., None]), dim=-1)  # (B, G, 3, 8)
    of_positions = (whitening @ J.transpose(-3, -2)).flatten(-3, -2)
    up = (S_ew[..., :3, :3] @ camera_up_w[..., None]).squeeze(-1)
    up = up / up.norm(dim=-1, keepdim=True)
    rest = torch.zeros(*of_positions.shape[:-2], 4, 8, dtype=moved.dtype, device=moved.device)
    rest[..., 0, 7] = 1 / clock_std
    rest[..., 1:, 3:6] = -skew(up) / CAMERA_UP_STD
    return torch.cat((of_positions, rest), dim=-2)


def _rescaled(
    S_ew: Float[Tensor, "4 4"], center_w: Float[Tensor, " 3"], factor: Float[Tensor, ""]
) -> Float[Tensor, "4 4"]:
    """The similarity with another scale, about a point of the map that stays where it is."""
    center_e = transform(S_ew, center_w[None])[0]
    scaled = S_ew.clone()
    scaled[:3, :3] = factor * S_ew[:3, :3]
    scaled[:3, 3] = center_e - scaled[:3, :3] @ center_w
    return scaled
