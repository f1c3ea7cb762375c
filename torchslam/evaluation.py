"""Absolute (ATE) and relative (RPE) pose errors of an estimated trajectory.

A monocular estimate has no scale of its own, so it is aligned to the ground truth by a similarity first.
Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012; Umeyama, 1991.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.trajectories import interpolate_poses, nearest
from torchslam.errors import TrajectoryError
from torchslam.geometry.lie import rigid, se3_inverse, so3_log
from torchslam.geometry.precision import full_precision
from torchslam.geometry.similarity import umeyama
from torchslam.types import Trajectory, check_ascending

Association = Literal["interpolate", "nearest"]

TOLERANCE = 0.02
"""Seconds: an estimated pose without a true one this near in time is left out."""
MIN_POSES = 3
"""Poses that two trajectories must have in common: fewer can be aligned without any error."""


@dataclass(frozen=True)
class Evaluation:
    """The errors of an estimate: root mean squares over the compared poses, in meters of the ground truth.

    Attributes:
        ate_m: absolute trajectory error of the positions after alignment by a similarity.
        ate_se3_m: of the positions after alignment by a rigid transform, with the scale of the estimate.
        rpe_translation_m: of the motion over `rpe_delta` poses, the estimate scaled by `scale`.
        rpe_rotation_deg: of the same motion.
        rpe_delta: number of poses.
        scale: true meters per unit of the estimate.
        path_length_m: length of the path through the true positions of the compared poses.
        posed: number of poses of the estimate.
        compared: number of these with a true pose.
        S_groundtruth_estimate: the similarity that aligns the estimate.
        aligned: the whole estimate, aligned.
        matched: the compared poses, aligned.
        groundtruth: the true poses at the same times.
        errors_m: distances between the positions of `matched` and `groundtruth`.
    """

    ate_m: float
    ate_se3_m: float
    rpe_translation_m: float
    rpe_rotation_deg: float
    rpe_delta: int
    scale: float
    path_length_m: float
    posed: int
    compared: int
    S_groundtruth_estimate: Float[Tensor, "4 4"]
    aligned: Trajectory
    matched: Trajectory
    groundtruth: Trajectory
    errors_m: Float[Tensor, " N"]

    def as_dict(self) -> dict[str, float | int | dict[str, float | int]]:
        """The figures, for metrics.json and tables."""
        return {
            "ate_m": self.ate_m,
            "ate_se3_m": self.ate_se3_m,
            "rpe": {
                "translation_m": self.rpe_translation_m,
                "rotation_deg": self.rpe_rotation_deg,
                "delta": self.rpe_delta,
            },
            "scale": self.scale,
            "path_length_m": self.path_length_m,
            "compared": self.compared,
        }


@full_precision
def evaluate(
    estimate: Trajectory,
    groundtruth: Trajectory,
    association: Association = "interpolate",
    tolerance: float = TOLERANCE,
    delta: int = 1,
) -> Evaluation:
    """Compare an estimate with the ground truth at the times of the estimate.

    Args:
        association: how to get the true pose at a time: from the two nearest ones, or the nearest as it is. Where the
            ground truth has a clock of its own, "nearest" charges the estimate with the motion in between (0.03 mm
            and 0.008 degrees a frame on TUM fr2_desk with its 300 Hz); at equal times both are the same.
        tolerance: maximum time to the nearest true pose, seconds; other estimated poses are left out.
        delta: number of poses over which relative motion is compared, fewer if there are fewer.

    Raises:
        TrajectoryError: Times repeat, fewer than three poses can be compared, or one of two paths is a single place.
        ValueError: An option is unknown or out of range.
    """
    if association not in (known := get_args(Association)):
        raise ValueError(f"unknown association {association!r}; known are {', '.join(known)}")
    if not tolerance >= 0:
        raise ValueError(f"tolerance must be seconds, not below zero, got {tolerance}")
    if delta < 1:
        raise ValueError(f"delta must be a number of poses, at least 1, got {delta}")
    for each in (estimate, groundtruth):
        check_ascending(each.timestamps, each.timestamps.diff() <= 0)
    device = groundtruth.T_wc.device
    times = estimate.timestamps.to(device=device, dtype=torch.float64)
    T_we = estimate.T_wc.detach().to(device=device, dtype=torch.float64)
    truth = Trajectory(groundtruth.timestamps.double(), groundtruth.T_wc.detach().double())
    T_wg, valid = _associate(truth, times, association, tolerance)
    compared = int(valid.sum())
    if compared < MIN_POSES:
        spans = ""
        if len(times) and len(truth):
            one, other = (f"{float(t[0]):.3f} to {float(t[-1]):.3f} s" for t in (times, truth.timestamps))
            spans = f"; the estimate goes from {one}, the ground truth from {other}"
        raise TrajectoryError(
            f"{compared} of {len(times)} estimated poses have a true one within {tolerance:g} s, "
            f"{MIN_POSES} are needed{spans}"
        )
    matched, reference = T_we[valid], T_wg[valid]
    moves, has_moved = (bool(_has_extent(T[:, :3, 3])) for T in (matched, reference))
    if moves != has_moved:
        name = "ground truth" if moves else "estimate"
        raise TrajectoryError(
            f"all {compared} compared positions of the {name} are the same, the others are not: nothing fixes the scale"
        )
    s, R, t = umeyama(matched[:, :3, 3], reference[:, :3, 3])
    aligned = Trajectory(times, rigid(R @ T_we[:, :3, :3], s * T_we[:, :3, 3] @ R.mT + t))
    errors = (aligned.positions_w[valid] - reference[:, :3, 3]).norm(dim=-1)
    T_ew, T_gw = se3_inverse(matched), se3_inverse(reference)
    delta = min(delta, compared - 1)
    rpe_translation, rpe_rotation = rpe(T_cw=T_ew, T_cw_groundtruth=T_gw, delta=delta)
    return Evaluation(
        ate_m=float(_rms(errors.square())),
        ate_se3_m=float(ate(T_cw=T_ew, T_cw_groundtruth=T_gw, with_scale=False)),
        rpe_translation_m=float(rpe_translation),
        rpe_rotation_deg=math.degrees(float(rpe_rotation)),
        rpe_delta=delta,
        scale=float(s),
        path_length_m=float(reference[:, :3, 3].diff(dim=0).norm(dim=-1).sum()),
        posed=len(times),
        compared=compared,
        S_groundtruth_estimate=rigid(s * R, t),
        aligned=aligned,
        matched=Trajectory(times[valid], aligned.T_wc[valid]),
        groundtruth=Trajectory(times[valid], reference),
        errors_m=errors,
    )


def ate_apart(parts: Iterable[Trajectory], groundtruth: Trajectory) -> float:
    """ATE of poses that were given in several submaps: RMS over all of them, meters.

    Each part is aligned by a similarity of its own, because the relative poses of the submaps were not known when the
    poses were given; so errors between the parts do not show. Options are the defaults of `evaluate`. Parts with fewer
    than three true poses, which fit any path, are left out.

    Raises:
        TrajectoryError: No part is left.
    """
    truth = Trajectory(groundtruth.timestamps.double(), groundtruth.T_wc.detach().double())
    errors = []
    for part in parts:
        times = part.timestamps.to(truth.T_wc)
        if int(_associate(truth, times, "interpolate", TOLERANCE)[1].sum()) >= MIN_POSES:
            errors.append(evaluate(part, groundtruth).errors_m)
    if not errors:
        raise TrajectoryError(
            f"no submap has {MIN_POSES} estimated poses with a true one within {TOLERANCE:g} s"
        )
    return float(_rms(torch.cat(errors).square()))


@full_precision
def ate(
    *,
    T_cw: Float[Tensor, "*batch N 4 4"],
    T_cw_groundtruth: Float[Tensor, "*batch N 4 4"],
    mask: Bool[Tensor, "*batch N"] | None = None,
    with_scale: bool = True,
) -> Float[Tensor, "*batch"]:
    """Absolute trajectory error: the root mean square distance of camera centers after alignment, meters.

    Differentiable, with a gradient of zero on exact data.

    Args:
        T_cw: estimated poses, world to camera; a `Trajectory` has the inverses.
        T_cw_groundtruth: true poses at the same times.
        mask: rows that count.
        with_scale: align by a similarity; False: by a rigid transform.

    Returns:
        The errors; NaN, with a gradient of zero, where fewer than `MIN_POSES` rows count, one is not finite, or the
        centers of one of both alone are all at one place, so that nothing fixes the scale.
    """
    T_cw, T_cw_groundtruth, known, enough = _counted(T_cw, T_cw_groundtruth, mask)
    centers, truth = _centers(T_cw), _centers(T_cw_groundtruth)
    s, R, t = umeyama(centers, truth, mask, with_scale)
    moved = s[..., None, None] * centers @ R.mT + t[..., None, :]
    error = _rms((moved - truth).square().sum(-1), mask)
    known = known & enough
    if with_scale:
        known = known & (_has_extent(truth, mask) == _has_extent(centers, mask))
    return torch.where(known, error, torch.nan)


@full_precision
def rpe(
    *,
    T_cw: Float[Tensor, "*batch N 4 4"],
    T_cw_groundtruth: Float[Tensor, "*batch N 4 4"],
    delta: int = 1,
    mask: Bool[Tensor, "*batch N"] | None = None,
    with_scale: bool = True,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Relative pose error: root mean squares of the error of the motion from each row to the one `delta` later.

    Differentiable.

    Args:
        T_cw: estimated poses, world to camera; a `Trajectory` has the inverses.
        T_cw_groundtruth: true poses at the same times.
        mask: rows that count.
        with_scale: scale the estimate as the alignment of `ate` does.

    Returns:
        Translation in meters and rotation in radians. Both are NaN, with a gradient of zero, where no two rows that
        count are `delta` apart, fewer than `MIN_POSES` count for that alignment, or one that counts is not finite.

    Raises:
        ValueError: `delta` is not between 1 and N - 1.
    """
    if not 1 <= delta < T_cw.shape[-3]:
        raise ValueError(f"delta must be between 1 and {T_cw.shape[-3] - 1}, got {delta}")
    T_cw, T_cw_groundtruth, known, enough = _counted(T_cw, T_cw_groundtruth, mask)
    s, _, _ = umeyama(_centers(T_cw), _centers(T_cw_groundtruth), mask, with_scale)
    # Each camera `delta` rows later, in the camera before.
    motion, true_motion = (
        T[..., :-delta, :, :] @ se3_inverse(T[..., delta:, :, :]) for T in (T_cw, T_cw_groundtruth)
    )
    motion = rigid(motion[..., :3, :3], s[..., None, None] * motion[..., :3, 3])
    error = se3_inverse(true_motion) @ motion
    pairs = None if mask is None else mask[..., :-delta] & mask[..., delta:]
    translation = error[..., :3, 3].square().sum(-1)
    rotation = so3_log(error[..., :3, :3]).square().sum(-1)
    known = known if pairs is None else known & pairs.any(-1)
    known = known & enough if with_scale else known
    errors = _rms(translation, pairs), _rms(rotation, pairs)
    return torch.where(known, errors[0], torch.nan), torch.where(known, errors[1], torch.nan)


def _has_extent(
    positions: Float[Tensor, "*batch N 3"], mask: Bool[Tensor, "*batch N"] | None = None
) -> Bool[Tensor, "*batch"]:
    """Test whether positions that count differ by more than rounding."""
    positions = positions.detach()
    used = torch.ones_like(positions[..., 0], dtype=torch.bool) if mask is None else mask
    used = used[..., None]
    high = torch.where(used, positions, -torch.inf).amax((-2,))
    low = torch.where(used, positions, torch.inf).amin((-2,))
    size = torch.where(used, positions.abs(), 0.0).amax((-2, -1))
    return (high - low).amax(-1) > 16 * torch.finfo(positions.dtype).eps * size


def _associate(
    truth: Trajectory, times: Float[Tensor, " N"], association: str, tolerance: float
) -> tuple[Float[Tensor, "N 4 4"], Bool[Tensor, " N"]]:
    """The true T_wc at each time, and whether there is one."""
    if len(truth) == 0 or len(times) == 0:
        return truth.T_wc.new_zeros(len(times), 4, 4), torch.zeros_like(times, dtype=torch.bool)
    if association == "interpolate":
        return interpolate_poses(truth, times, tolerance)
    indices, distances = nearest(times, truth.timestamps)
    return truth.T_wc[indices], distances <= tolerance


def _counted(
    T_cw: Float[Tensor, "*batch N 4 4"],
    T_cw_groundtruth: Float[Tensor, "*batch N 4 4"],
    mask: Bool[Tensor, "*batch N"] | None,
) -> tuple[Tensor, Tensor, Bool[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Both with the identity for rows that are not finite; whether all rows that count are, and enough to align."""
    finite = torch.isfinite(T_cw).flatten(-2).all(-1) & torch.isfinite(T_cw_groundtruth).flatten(-2).all(-1)
    eye = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
    T_cw, T_cw_groundtruth = (torch.where(finite[..., None, None], T, eye) for T in (T_cw, T_cw_groundtruth))
    rows = torch.ones_like(finite) if mask is None else mask
    return T_cw, T_cw_groundtruth, (finite | ~rows).all(-1), rows.sum(-1) >= MIN_POSES


def _centers(T_cw: Float[Tensor, "*batch N 4 4"]) -> Float[Tensor, "*batch N 3"]:
    """Camera centers in the world."""
    return se3_inverse(T_cw)[..., :3, 3]


def _rms(
    squares: Float[Tensor, "*batch N"], mask: Bool[Tensor, "*batch N"] | None = None
) -> Float[Tensor, "*batch"]:
    """The root of the mean of the last dimension's squares, with a gradient of zero at zero."""
    weights = torch.ones_like(squares) if mask is None else mask.to(squares.dtype)
    mean = (weights * torch.where(weights > 0, squares, 0.0)).sum(-1) / weights.sum(-1).clamp(min=1.0)
    positive = mean > 0
    return torch.where(positive, torch.where(positive, mean, 1.0).sqrt(), 0.0)
