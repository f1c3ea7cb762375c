"""The definition of a bundle adjustment, the same as finite tensors that all lead with a batch, and its priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import se3_adjoint, transform
from torchslam.geometry.robust import kernel_scale
from torchslam.optim._core.residuals import only, usable
from torchslam.optim._core.tangent import CameraPrior, PosePrior, prior_expansion, prior_hessian, rotated
from torchslam.optim.bundle._factors import (
    DepthPrior,
    FactorKind,
    Factors,
    FrameBlocks,
    LinearErrors,
    PointBlocks,
    frames_with_factors,
    packed_factors,
)
from torchslam.utils.by_value import ByValue
from torchslam.utils.indexing import row_mask


@dataclass(frozen=True, eq=False)
class BundleProblem(ByValue):
    """O observations of N points by K frames; or a batch of B such problems.

    `T_cw` (B, K, 4, 4) makes it a batch. Everything else may lead with B, too; without, it is shared by all problems.

    Attributes:
        T_cw: world to camera, the start.
        points_w: start.
        frame_index: rows of T_cw.
        point_index: rows of points_w.
        camera: one for all frames, params (P,); with `camera_index` C cameras of one model and size, (C, P).
        weights: inverse variances in px^-2, or (O, 2, 2) inverse covariances, which count where they are positive
            definite; one if None.
        fixed_frames: rows of T_cw, or a (K,) bool mask. One fixed frame leaves the scale open, which then stays that
            of the start; without any, position and orientation stay as well.
        fixed_points: rows of points_w, or a (N,) bool mask.
        mask: observations that count, all if None. Padding of smaller problems in a batch may hold any
            values, with indices in range.
        camera_index: camera of each frame.
        pose_prior: T_cw (K, 4, 4) and information (K, 6, 6), zero for frames without a prior.
        camera_prior: prior on the parameters of free cameras.
        depth_prior: measured depths of the observed points.
        factors: measured motions, heights, planes, lengths and the like, or custom residuals. A batch with factors
            or depths is solved one problem after the other.
    """

    T_cw: Float[Tensor, "*#batch K 4 4"]
    points_w: Float[Tensor, "*#batch N 3"]
    frame_index: Int[Tensor, "*#batch O"]
    point_index: Int[Tensor, "*#batch O"]
    pixels: Float[Tensor, "*#batch O 2"]
    camera: Camera
    weights: Float[Tensor, "*#batch O"] | Float[Tensor, "*#batch O 2 2"] | None = None
    fixed_frames: Shaped[Tensor, "..."] | Sequence[int] = (0,)
    fixed_points: Shaped[Tensor, "..."] | Sequence[int] | None = None
    mask: Bool[Tensor, "*#batch O"] | None = None
    camera_index: Int[Tensor, "*#batch K"] | None = None
    pose_prior: PosePrior | None = None
    camera_prior: CameraPrior | None = None
    depth_prior: DepthPrior | None = None
    factors: Sequence[Factors] = ()

    @property
    def is_batch(self) -> bool:
        return self.T_cw.ndim == 4


class BundleData(NamedTuple):
    """All that bundle adjustments are made of: finite tensors, of a batch each leading with B.

    First what gradients may flow to: params (C, P), scale (); priors, depths and factors have no rows where there are
    none, depths are by observation, and what factors measure is flat, as `packed_factors` has it. Then which
    observations count (O,), whether all frames are finite that anything counts of (), the rows of `BundleProblem`, and
    which frames and points may move, (K,) and (N,).
    """

    T_cw: Tensor
    points_w: Tensor
    pixels: Tensor
    weights: Tensor
    params: Tensor
    scale: Tensor
    prior_T_cw: Tensor
    prior_information: Tensor
    prior_params: Tensor
    prior_params_information: Tensor
    depths: Tensor
    depth_information: Tensor
    measured: Tensor
    factor_information: Tensor
    counted: Tensor
    finite: Tensor
    frame_index: Tensor
    point_index: Tensor
    camera_index: Tensor
    free_frames: Tensor
    free_points: Tensor

    @property
    def pose_prior(self) -> PosePrior | None:
        return PosePrior(self.prior_T_cw, self.prior_information) if self.prior_T_cw.shape[-3] else None

    @property
    def camera_prior(self) -> CameraPrior | None:
        has_rows = bool(self.prior_params.shape[-2])
        return CameraPrior(self.prior_params, self.prior_params_information) if has_rows else None

    @property
    def has_priors(self) -> bool:
        """Whether there is a prior, on poses or on the camera."""
        return self.pose_prior is not None or self.camera_prior is not None

    @property
    def camera_of(self) -> Tensor:
        """The camera (..., O) of each observation."""
        return self.camera_index.gather(-1, self.frame_index)

    def part(self, rows: slice | int) -> BundleData:
        """Some elements of the batch, or one."""
        return BundleData(*(tensor[rows] for tensor in self))


class BundleEstimate(NamedTuple):
    """Poses, points and camera parameters, in the order of the problem or of a layout."""

    T_cw: Float[Tensor, "*batch K 4 4"]
    points_w: Float[Tensor, "*batch N 3"]
    params: Float[Tensor, "*batch C P"]


_MIN_PARALLAX = 1e-4
"""Radians, 0.05 pixels with a focal length of 500: depth is then as uncertain as it is large, or more so."""


class MovingParts(NamedTuple):
    """Masks of the observations that count and of the frames and points that move."""

    counted: Bool[Tensor, "B O"]
    frames: Bool[Tensor, "B K"]
    points: Bool[Tensor, "B N"]


def select_moving(given: BundleData, kinds: Sequence[FactorKind] = ()) -> MovingParts:
    """Of what may move, points seen less than twice and frames that see less than three points and have no prior and no
    factor stay, and are not observed."""
    frame_index, point_index, counted = given.frame_index, given.point_index, given.counted
    seen = _counts(point_index, counted, given.free_points) >= 2
    counted = counted & (seen | ~given.free_points).gather(1, point_index)
    seeing = _counts(frame_index, counted, given.free_frames) >= 3
    seeing = seeing | _held_frames(given, kinds)
    counted = counted & (seeing | ~given.free_frames).gather(1, frame_index)
    return MovingParts(counted, given.free_frames & seeing, given.free_points & seen)


def points_with_parallax(given: BundleData, used: Tensor, at: BundleEstimate) -> Bool[Tensor, "B N"]:
    """Which points the used observations (B, O) see from different directions; the others have no depth."""
    in_frames = flat_rows(given.frame_index, at.T_cw.shape[1])
    in_points = flat_rows(given.point_index, at.points_w.shape[1])
    centers_w = -(at.T_cw[..., :3, :3].mT @ at.T_cw[..., :3, 3:]).squeeze(-1).flatten(0, 1)
    points_w = at.points_w.flatten(0, 1)
    rays_w = torch.nn.functional.normalize(points_w[in_points] - centers_w[in_frames], dim=-1)
    rays_w = torch.cat((rays_w, torch.ones_like(rays_w[:, :1])), dim=-1) * used.flatten()[:, None]
    sums = torch.zeros(len(points_w), 4, dtype=rays_w.dtype, device=rays_w.device)
    sums = sums.index_add(0, in_points, rays_w).unflatten(0, at.points_w.shape[:2])
    # Two directions an angle a apart have a mean of length cos(a / 2).
    missing = 1 - (sums[..., :3] / sums[..., 3:].clamp_min(1)).square().sum(-1)
    least = max((_MIN_PARALLAX / 2) ** 2, 16 * torch.finfo(sums.dtype).eps)
    return (sums[..., 3] > 0) & (missing > least)


def frames_are_determined(
    given: BundleData, moving: MovingParts, with_parallax: Bool[Tensor, "B N"], kinds: Sequence[FactorKind]
) -> Bool[Tensor, " B"]:
    """Whether all frames that move see three points with a depth, or have a prior or a factor."""
    has_depth = (with_parallax | ~moving.points).gather(1, given.point_index)
    enough = _counts(given.frame_index, moving.counted & has_depth, moving.frames) >= 3
    return (enough | _held_frames(given, kinds) | ~moving.frames).all(1)


def _held_frames(given: BundleData, kinds: Sequence[FactorKind]) -> Tensor:
    """Which frames (B, K) have a prior or a factor."""
    held = frames_with_factors(kinds, given.factor_information, given.T_cw.shape[1])
    if given.pose_prior is not None:
        held = held | (given.prior_information != 0).flatten(2).any(-1)
    return held


def _counts(index: Tensor, counted: Tensor, of: Tensor) -> Tensor:
    """How many counted rows of index (B, O) there are of each of `of`."""
    rows = flat_rows(index, of.shape[1])[counted.flatten()]
    return torch.bincount(rows, minlength=of.numel()).view(of.shape)


def flat_rows(index: Int[Tensor, "B O"], size: int) -> Int[Tensor, " R"]:
    """Rows (B * O,) of what was (B, size, ...) and is flattened to (B * size, ...), for index (B, O)."""
    return (index + size * torch.arange(len(index), device=index.device)[:, None]).flatten()


def sanitized(problem: BundleProblem, scale: Tensor | float) -> BundleData:
    """The problem as a batch, with zero or the identity for what is not finite; raises ValueError for shapes, dtypes
    and indices that do not fit."""
    T_cw = problem.T_cw if problem.is_batch else problem.T_cw[None]
    if not len(T_cw):
        raise ValueError("a batch must have a problem")
    points_w, pixels, weights, mask = _rows(problem, T_cw)
    params, camera_index = _cameras(problem, T_cw)
    priors = _priors(problem, T_cw, params)
    depths, depth_information = (T_cw.new_zeros(len(T_cw), 0),) * 2
    if (depth := problem.depth_prior) is not None:
        depths = _over("depth_prior.depths", "(O,)", depth.depths, tuple(mask.shape))
        depth_information = _over("depth_prior.information", "(O,)", depth.information, tuple(mask.shape))
    measured, factor_information = packed_factors(problem.factors, T_cw, points_w.shape[1])
    (batch, num_frames), num_points = T_cw.shape[:2], points_w.shape[1]
    rows = mask.shape
    frame_index = checked_rows("frame_index", problem.frame_index, rows, num_frames)
    point_index = checked_rows("point_index", problem.point_index, rows, num_points)

    is_finite = torch.isfinite(T_cw).flatten(2).all(-1)
    seen_points = points_w.flatten(0, 1)[flat_rows(point_index, num_points)].unflatten(0, rows)
    counted = mask & usable(pixels, seen_points, weights) & is_finite.gather(1, frame_index)
    counts = frame_index.new_zeros(batch, num_frames)
    is_observing = counts.scatter_add(1, frame_index, mask.long()) > 0
    if depths.shape[1]:
        use = counted & depths.isfinite() & (depths > 0)
        use = use & depth_information.isfinite() & (depth_information > 0)
        depths, depth_information = torch.where(use, depths, 1.0), torch.where(use, depth_information, 0.0)
    eye = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
    return BundleData(
        torch.where(is_finite[..., None, None], T_cw, eye),
        torch.where(torch.isfinite(points_w), points_w, 0.0),
        torch.where(counted[..., None], pixels, 0.0),
        only(counted, weights),
        params,
        kernel_scale(scale, T_cw).expand(batch),
        *priors,
        depths,
        depth_information,
        measured,
        factor_information,
        counted,
        (is_finite | ~is_observing).all(-1),
        frame_index,
        point_index,
        camera_index,
        is_finite & ~row_mask("fixed_frames", problem.fixed_frames, is_finite),
        ~row_mask("fixed_points", problem.fixed_points, points_w[..., 0]),
    )


def _rows(problem: BundleProblem, T_cw: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points (B, N, 3), and of the observations pixels (B, O, 2), weights (B, O, ...) and mask (B, O)."""
    points_w, pixels, weights, mask = problem.points_w, problem.pixels, problem.weights, problem.mask
    batch, count = len(T_cw), pixels.shape[-2]
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    mask = torch.ones_like(pixels[..., 0], dtype=torch.bool) if mask is None else mask
    matrix = (2, 2) if weights.shape[-2:] == (2, 2) and weights.shape[-3:-2] == (count,) else ()
    return (
        _over("points_w", "(N, 3)", points_w, (batch, points_w.shape[-2], 3)),
        _over("pixels", "(O, 2)", pixels, (batch, count, 2)),
        _over("weights", "(O,) or (O, 2, 2)", weights, (batch, count, *matrix)),
        _over("mask", "(O,)", mask, (batch, count)),
    )


def _cameras(problem: BundleProblem, T_cw: Tensor) -> tuple[Tensor, Tensor]:
    """Parameters (B, C, P) and the camera of each frame (B, K)."""
    # A copy: parameters may move in place before the covariance is asked for.
    params, index = problem.camera.params.clone(), problem.camera_index
    if index is None:
        params = _over("camera.params", "(P,)", params, (len(T_cw), params.shape[-1]))
        return params[:, None], torch.zeros(T_cw.shape[:2], dtype=torch.int64, device=T_cw.device)
    params = _over("camera.params", "(C, P)", params, (len(T_cw), *params.shape[-2:]))
    return params, checked_rows("camera_index", index, T_cw.shape[:2], params.shape[1])


def _priors(problem: BundleProblem, T_cw: Tensor, params: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means and informations (B, K, 4, 4), (B, K, 6, 6), (B, C, P), (B, C, P, P), without rows where there are none."""
    (batch, num_frames), (_, num_cameras, size) = T_cw.shape[:2], params.shape
    poses, camera = problem.pose_prior, problem.camera_prior
    if poses is None:
        poses = PosePrior(T_cw.new_zeros(0, 4, 4), T_cw.new_zeros(0, 6, 6))
        num_frames = 0
    if camera is None:
        camera = CameraPrior(T_cw.new_zeros(0, size), T_cw.new_zeros(0, size, size))
        num_cameras = 0
    elif problem.camera_index is None:  # of the only one
        camera = CameraPrior(camera.params[..., None, :], camera.information[..., None, :, :])
    shape, square = (batch, num_cameras, size), (batch, num_cameras, size, size)
    return (
        _over("pose_prior.T_cw", "(K, 4, 4)", poses.T_cw, (batch, num_frames, 4, 4)),
        _over("pose_prior.information", "(K, 6, 6)", poses.information, (batch, num_frames, 6, 6)),
        _over("camera_prior.params", "as those of the camera", camera.params, shape),
        _over("camera_prior.information", "a square matrix per camera", camera.information, square),
    )


def _over(name: str, described: str, tensor: Tensor, shape: tuple[int, ...]) -> Tensor:
    """A tensor with the batch, whether or not it has it already."""
    if tensor.shape not in (shape, shape[1:]):
        raise ValueError(f"{name} must be {described} = {shape[1:]}, not {tuple(tensor.shape)}")
    return tensor.expand(shape)


def checked_rows(name: str, index: Tensor, shape: tuple[int, ...], size: int) -> Tensor:
    """Rows (B, M) that lie in 0 ... size - 1."""
    if index.shape not in (shape, shape[1:]):
        each = "frame" if name == "camera_index" else "observation"
        raise ValueError(f"{name} must have one row per {each}, {shape[-1]}, not {tuple(index.shape)}")
    if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < size:
        raise ValueError(f"{name} must lie in 0 ... {size - 1}")
    return index.expand(shape)


class PriorTerms(NamedTuple):
    """Cost (...), and gradients and Hessians over frames (..., K, 6) and the n free directions of cameras (..., C,
    n); with factors what they add, and the Hessian over frames without them."""

    cost: Tensor
    frames_gradient: Tensor
    frames: Tensor
    cameras_gradient: Tensor
    cameras: Tensor
    between: FrameBlocks | None = None
    points: PointBlocks | None = None
    errors: tuple[LinearErrors, ...] = ()
    of_priors: Tensor | None = None

    def in_world(self, R_cw: Tensor) -> PriorTerms:
        """The same for frames (..., K, 3, 3) that move along the axes of the world."""
        R_wc = R_cw.mT
        return self._replace(
            frames_gradient=rotated(R_wc, self.frames_gradient[..., None])[..., 0],
            frames=rotated(R_wc, rotated(R_wc, self.frames).mT),
        )


def prior_terms(
    given: BundleData, T_cw: Tensor, params: Tensor, moving: Tensor, directions: Tensor | None, exact: bool
) -> PriorTerms:
    """The terms at poses (..., K, 4, 4) and parameters (..., C, P), which move along directions (P, n) or not at all.

    moving: (..., K) bool, of which frames the prior counts; exact: the exact Hessian, not that of Gauss and Newton
    """
    poses, camera = given.pose_prior, given.camera_prior
    cost = T_cw.new_zeros(T_cw.shape[:-3])
    g_frames, H_frames = T_cw.new_zeros(*T_cw.shape[:-2], 6), T_cw.new_zeros(*T_cw.shape[:-2], 6, 6)
    if poses is not None:
        poses = PosePrior(poses.T_cw, torch.where(moving[..., None, None], poses.information, 0.0))
        costs, g_frames, H_frames = prior_expansion(poses, T_cw)
        cost = cost + costs.sum(-1)
        if exact:
            flat = PosePrior(poses.T_cw.reshape(-1, 4, 4), poses.information.reshape(-1, 6, 6))
            H_frames = prior_hessian(flat, T_cw.reshape(-1, 4, 4)).view_as(H_frames)
    free = 0 if directions is None else directions.shape[-1]
    g_camera = params.new_zeros(*params.shape[:-1], free)
    H_camera = params.new_zeros(*g_camera.shape, free)
    if camera is not None and directions is not None:
        off = params - camera.params
        pulled = (camera.information @ off[..., None]).squeeze(-1)
        cost = cost + 0.5 * (off * pulled).sum((-2, -1))
        g_camera, H_camera = pulled @ directions, directions.mT @ camera.information @ directions
    return PriorTerms(cost, g_frames, H_frames, g_camera, H_camera)


def block_diagonal(blocks: Float[Tensor, "*batch M D D"]) -> Float[Tensor, "*batch MD MD"]:
    """The block-diagonal matrix of M blocks."""
    rows = torch.diag_embed(blocks.movedim(-3, -1), dim1=-4, dim2=-2)
    return rows.flatten(-2).flatten(-3, -2)


def gauge_motions(T_cw: Float[Tensor, "*batch K 4 4"], origin_w: Tensor) -> Float[Tensor, "*batch K 6 7"]:
    """How frames (..., K, 4, 4) move along the axes of the world, (..., K, 6, 7): with the scale about a point
    (..., 3) or (..., 1, 3), and with each of the six rigid motions of the world."""
    scaling = torch.nn.functional.pad(transform(T_cw, origin_w[..., None, :]).squeeze(-2), (0, 3))[..., None]
    return rotated(T_cw[..., :3, :3].mT, torch.cat((scaling, -se3_adjoint(T_cw)), dim=-1))


def open_motions(
    motions: Float[Tensor, "*batch K 6 g"], held: Float[Tensor, "*batch g g"]
) -> Float[Tensor, "*batch K 6 g"]:
    """Of orthonormal motions (..., K, 6, g) of all frames those without a stiffness, `held`; else zero."""
    stiffness, mixtures = torch.linalg.eigh(held)
    is_open = stiffness <= torch.finfo(held.dtype).eps ** 0.5 * stiffness[..., -1:]
    return motions @ (mixtures * is_open[..., None, :])[..., None, :, :]


def stiffness_along(
    motions: Float[Tensor, "*batch K 6 g"], frames: Float[Tensor, "*batch K 6 6"]
) -> Float[Tensor, "*batch g g"]:
    """The Hessian along motions of all frames, given the block of each frame."""
    return (motions.mT @ frames @ motions).sum(-3)
