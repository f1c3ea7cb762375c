"""How far an estimated trajectory is from the true one: absolute (ATE) and relative (RPE) pose errors.

A monocular estimate has no scale of its own, so that it is aligned to the ground truth by a similarity first.
Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012; Umeyama, 1991.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchslam.data.trajectories import interpolate_poses, nearest
from torchslam.errors import TrajectoryError
from torchslam.geometry.lie import rigid, se3_inverse, so3_log
from torchslam.geometry.precision import full_precision
from torchslam.geometry.similarity import umeyama
from torchslam.types import Trajectory

TOLERANCE = 0.02
"""Seconds: an estimated pose without a true one this near in time is left out."""
MIN_POSES = 3
"""Poses that two trajectories must have in common: fewer can be aligned without any error."""


@dataclass(frozen=True)
class Evaluation:
    """The errors of an estimate. Root mean squares, over the compared poses; metres of the ground truth.

    ate_m:         of the positions after alignment by a similarity
    ate_se3_m:     after alignment by a rigid transform, the scale taken as it is
    rpe_translation_m, rpe_rotation_deg: of the motion over `rpe_delta` poses, the estimate scaled by `scale`
    scale:         true metres per unit of the estimate
    path_length_m: of the true positions at the compared poses
    posed, compared: poses of the estimate, and those among them with a true pose
    S_groundtruth_estimate: (4, 4) the similarity [s R, t; 0, 1] that aligns the estimate
    aligned:       the whole estimate after that similarity
    matched, groundtruth: the compared poses, aligned, and the true ones at the same times
    errors_m:      (compared,) distances between these two
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
    S_groundtruth_estimate: Tensor
    aligned: Trajectory
    matched: Trajectory
    groundtruth: Trajectory
    errors_m: Tensor

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
    association: Literal["interpolate", "nearest"] = "interpolate",
    tolerance: float = TOLERANCE,
    delta: int = 1,
) -> Evaluation:
    """Compare an estimate with the ground truth at the times of the estimate.

    association: the true pose between the two nearest in time, or the nearest one as it is. Where the ground truth
                 has a clock of its own, "nearest" charges the estimate with the motion in between (0.03 mm and
                 0.008 degrees a frame on TUM fr2_desk with its 300 Hz); at equal times both are the same.
    tolerance:   seconds to the nearest true pose beyond which an estimated one is left out
    delta:       poses over which relative motion is compared, fewer where there are fewer

    Raises TrajectoryError where fewer than three poses can be compared.
    """
    device = groundtruth.T_wc.device
    times = estimate.timestamps.to(device=device, dtype=torch.float64)
    T_we = estimate.T_wc.detach().to(device=device, dtype=torch.float64)
    truth = Trajectory(groundtruth.timestamps.double(), groundtruth.T_wc.detach().double())
    T_wg, valid = _associate(truth, times, association, tolerance)
    compared = int(valid.sum())
    if compared < MIN_POSES:
        raise TrajectoryError(
            f"{compared} of {len(times)} estimated poses have a true one within {tolerance:g} s, "
            f"{MIN_POSES} are needed{_ranges(times, truth.timestamps)}"
        )
    matched, reference = T_we[valid], T_wg[valid]
    s, R, t = umeyama(matched[:, :3, 3], reference[:, :3, 3])
    aligned = Trajectory(times, _aligned(T_we, s, R, t))
    errors = (aligned.positions_w[valid] - reference[:, :3, 3]).norm(dim=-1)
    T_ew, T_gw = se3_inverse(matched), se3_inverse(reference)
    delta = min(delta, compared - 1)
    rpe_translation, rpe_rotation = rpe(T_ew, T_gw, delta)
    S = torch.eye(4, dtype=torch.float64, device=device)
    S[:3, :3], S[:3, 3] = s * R, t
    return Evaluation(
        ate_m=float(_rms(errors.square())),
        ate_se3_m=float(ate(T_ew, T_gw, with_scale=False)),
        rpe_translation_m=float(rpe_translation),
        rpe_rotation_deg=math.degrees(float(rpe_rotation)),
        rpe_delta=delta,
        scale=float(s),
        path_length_m=float(reference[:, :3, 3].diff(dim=0).norm(dim=-1).sum()),
        posed=len(times),
        compared=compared,
        S_groundtruth_estimate=S,
        aligned=aligned,
        matched=Trajectory(times[valid], aligned.T_wc[valid]),
        groundtruth=Trajectory(times[valid], reference),
        errors_m=errors,
    )


def ate_apart(parts: Iterable[Trajectory], groundtruth: Trajectory) -> float:
    """The ATE of poses that were given in several submaps: RMS over all of them, metres.

    Each part is aligned by a similarity of its own. When these poses were given, nothing was known of how their submaps
    lie to each other; what was learned later would either better or worsen what was given then. The price: errors
    between the parts do not show. Options as `evaluate` has them by default. Parts with fewer than three true poses,
    which fit any path, are left out; raises TrajectoryError where none is left.
    """
    errors = [
        evaluate(part, groundtruth).errors_m for part in parts if _compared(part, groundtruth) >= MIN_POSES
    ]
    if not errors:
        raise TrajectoryError(
            f"no submap has {MIN_POSES} estimated poses with a true one within {TOLERANCE:g} s"
        )
    return float(_rms(torch.cat(errors).square()))


def _compared(estimate: Trajectory, groundtruth: Trajectory) -> int:
    """How many poses of the estimate have a true one."""
    truth = Trajectory(groundtruth.timestamps.double(), groundtruth.T_wc.detach().double())
    times = estimate.timestamps.to(truth.T_wc)
    return int(_associate(truth, times, "interpolate", TOLERANCE)[1].sum())


@full_precision
def ate(
    T_cw: Tensor, T_cw_groundtruth: Tensor, mask: Tensor | None = None, with_scale: bool = True
) -> Tensor:
    """Absolute trajectory error: the root mean square distance of camera centres after alignment, metres.

    T_cw, T_cw_groundtruth: (..., N, 4, 4), row by row at the same times; mask: (..., N) rows that count
    Returns (...), differentiable, with a gradient of zero on exact data; NaN, with a gradient of zero, where fewer than
    `MIN_POSES` rows count. Aligned by a similarity, or by a rigid transform without `with_scale`.
    """
    centres, truth = _centers(T_cw), _centers(T_cw_groundtruth)
    s, R, t = umeyama(centres, truth, mask, with_scale)
    moved = s[..., None, None] * centres @ R.mT + t[..., None, :]
    error = _rms((moved - truth).square().sum(-1), mask)
    return torch.where(_enough(T_cw, mask), error, torch.nan)


@full_precision
def rpe(
    T_cw: Tensor,
    T_cw_groundtruth: Tensor,
    delta: int = 1,
    mask: Tensor | None = None,
    with_scale: bool = True,
) -> tuple[Tensor, Tensor]:
    """Relative pose error: root mean squares of the error of the motion from each row to the one `delta` later.

    T_cw, T_cw_groundtruth: (..., N, 4, 4), row by row at the same times; mask: (..., N) rows that count
    Returns translation (...) metres and rotation (...) radians, differentiable. With `with_scale` the estimate takes
    its scale from the alignment of `ate`. Both are NaN, with a gradient of zero, where no two rows that count are
    `delta` apart, or fewer than `MIN_POSES` count for that alignment.
    """
    if not 1 <= delta < T_cw.shape[-3]:
        raise ValueError(f"delta must be between 1 and {T_cw.shape[-3] - 1}, got {delta}")
    s, _, _ = umeyama(_centers(T_cw), _centers(T_cw_groundtruth), mask, with_scale)
    motion, true_motion = _motions(T_cw, delta), _motions(T_cw_groundtruth, delta)
    motion = rigid(motion[..., :3, :3], s[..., None, None] * motion[..., :3, 3])
    error = se3_inverse(true_motion) @ motion
    pairs = None if mask is None else mask[..., :-delta] & mask[..., delta:]
    translation = error[..., :3, 3].square().sum(-1)
    rotation = so3_log(error[..., :3, :3]).square().sum(-1)
    known = torch.ones_like(s, dtype=torch.bool) if pairs is None else pairs.any(-1)
    known = known & _enough(T_cw, mask) if with_scale else known
    errors = _rms(translation, pairs), _rms(rotation, pairs)
    return torch.where(known, errors[0], torch.nan), torch.where(known, errors[1], torch.nan)


def _associate(truth: Trajectory, times: Tensor, association: str, tolerance: float) -> tuple[Tensor, Tensor]:
    """(N, 4, 4) the true T_wc at each time and (N,) whether there is one."""
    if len(truth) == 0 or len(times) == 0:
        return truth.T_wc.new_zeros(len(times), 4, 4), torch.zeros_like(times, dtype=torch.bool)
    if association == "interpolate":
        return interpolate_poses(truth, times, tolerance)
    indices, distances = nearest(times, truth.timestamps)
    return truth.T_wc[indices], distances <= tolerance


def _ranges(times: Tensor, truth_times: Tensor) -> str:
    """From when to when either goes, where both go somewhere: mostly what is wrong."""
    if len(times) == 0 or len(truth_times) == 0:
        return ""
    spans = [f"from {float(span[0]):.3f} to {float(span[-1]):.3f} s" for span in (times, truth_times)]
    return f"; the estimate goes {spans[0]}, the ground truth {spans[1]}"


def _aligned(T_wc: Tensor, s: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """Camera poses (N, 4, 4) after a similarity of the world."""
    return rigid(R @ T_wc[:, :3, :3], s * T_wc[:, :3, 3] @ R.mT + t)


def _enough(T_cw: Tensor, mask: Tensor | None) -> Tensor:
    """(...) bool, enough rows (..., N) count for an alignment to say something."""
    rows = T_cw.new_ones(T_cw.shape[:-2], dtype=torch.bool) if mask is None else mask
    return rows.sum(-1) >= MIN_POSES


def _centers(T_cw: Tensor) -> Tensor:
    """(..., N, 3) camera centres in the world."""
    return se3_inverse(T_cw)[..., :3, 3]


def _motions(T_cw: Tensor, delta: int) -> Tensor:
    """(..., N - delta, 4, 4) each camera `delta` rows later, in the camera before."""
    return T_cw[..., :-delta, :, :] @ se3_inverse(T_cw[..., delta:, :, :])


def _rms(squares: Tensor, mask: Tensor | None = None) -> Tensor:
    """The root of the mean of the last dimension's squares, with a gradient of zero at zero."""
    weights = torch.ones_like(squares) if mask is None else mask.to(squares.dtype)
    mean = (weights * torch.where(weights > 0, squares, 0.0)).sum(-1) / weights.sum(-1).clamp(min=1.0)
    positive = mean > 0
    return torch.where(positive, torch.where(positive, mean, 1.0).sqrt(), 0.0)
