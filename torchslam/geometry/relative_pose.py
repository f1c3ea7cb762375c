"""The relative pose of two views from their matches, some of them wrong, and the model that explains them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.essential import essential_from_pose, sampson_errors
from torchslam.geometry.estimate_gradients import (
    implicit_step,
    needs_gradient,
    refuse_transforms,
    with_zero_gradient,
)
from torchslam.geometry.homography import transfer_errors
from torchslam.geometry.lie import rigid, so3_exp
from torchslam.geometry.motion_models import ESSENTIAL, HOMOGRAPHY, MODELS, ROTATION
from torchslam.geometry.precision import full_precision
from torchslam.geometry.ransac import CONFIDENCE, check_search
from torchslam.geometry.relative_pose_search import (
    KERNEL_WIDTH,
    FoundPose,
    Model,
    find_relative_pose,
)
from torchslam.geometry.robust import Kernel, robustify
from torchslam.geometry.two_view import TwoViews, tangent_basis

_MODELS, _KERNELS = get_args(Model), get_args(Kernel)


@dataclass(frozen=True)
class RelativePose:
    """Relative poses of B pairs of views.

    Attributes:
        T_21: from camera 1 to camera 2, translation of length one, or zero for "rotation"; the identity, without
            gradient, where the inliers may be an accident. Where it is `ambiguous`, or a "rotation", which does not
            determine the direction, this is the more likely pose or the rotation, with its gradient, though
            `success` is False.
        inliers: matches within the threshold of the chosen model.
        success: whether rotation and direction are determined: the inliers are significant, the motion is no
            pure rotation, and the plane, if any, is not ambiguous.
        model: B strings, "essential", "homography" (a plane explains the matches) or
            "rotation".
        model_index: indices of these models, in this order.
        ambiguous: whether the matches lie on a plane and two motions explain them; T_21 is the more likely one.
        score_essential: sum over the matches of 1 - min((error / threshold)^2, 1); zero if not requested.
        score_homography: as `score_essential`.
        score_rotation: as `score_essential`.
        T_21_essential: the pose of the essential matrix, whatever was chosen, without gradient: a guess
            where there is no `success`.
    """

    T_21: Float[Tensor, "B 4 4"]
    inliers: Bool[Tensor, "B N"]
    success: Bool[Tensor, " B"]
    model_index: Int[Tensor, " B"]
    ambiguous: Bool[Tensor, " B"]
    score_essential: Float[Tensor, " B"]
    score_homography: Float[Tensor, " B"]
    score_rotation: Float[Tensor, " B"]
    T_21_essential: Float[Tensor, "B 4 4"]

    @property
    def model(self) -> tuple[str, ...]:
        """Names of the models, one for each pair."""
        return tuple(MODELS[index] for index in self.model_index.tolist())


@full_precision
def estimate_relative_pose(
    pixels_1: Float[Tensor, "B N 2"],
    pixels_2: Float[Tensor, "B N 2"],
    *,
    camera_1: Camera,
    camera_2: Camera,
    threshold: float = 1.0,
    mask: Bool[Tensor, "B N"] | None = None,
    seed: int = 0,
    confidence: float = CONFIDENCE,
    max_samples: int = 4000,
    model: Model = "auto",
    kernel: Kernel = "cauchy",
    weights: Float[Tensor, "B N"] | None = None,
    min_samples: int = 512,
) -> RelativePose:
    """Estimate relative poses of B pairs of views by RANSAC over five-point essential matrices, with model selection.

    With `model="auto"` a homography and a pure rotation are fitted as well. The richer model is chosen only if
    matches that it explains contradict the simpler one, by one of these criteria (all but the first need another
    kernel than "truncated"):

    1. There are more such matches than chance would bring.
    2. All together lie to one side of the simpler model, along their epipolar lines. Noise of any size has no
       direction; that of edges has one, but goes both ways, so that as many matches end up behind the cameras.
    3. What the simpler model explains is accidental.
    4. No motion in front of the plane explains the matches as well as the essential matrix.

    A pure rotation, or a plane with two valid motions, gives `success` False; so do too few matches and pure noise.
    The same arguments and seed give the same result. Where an input requires a gradient, T_21 carries that of the
    final least squares of the chosen model with respect to pixels, weights and camera parameters, with the matches
    in use and the noise level fixed (implicit function theorem). Sources: Nister, 2004; Chum et al., "Locally
    optimized RANSAC", 2003; Torr, "An assessment of information criteria for motion model selection", 1997.

    Args:
        pixels_1: matches in the first view.
        pixels_2: matches in the second view.
        camera_1: of the first view, one or B.
        camera_2: of the second view, one or B.
        threshold: pixels, about the noise of one coordinate or somewhat more, for matches of weight one.
        mask: matches in use; those with NaN are never used.
        seed: of the random samples.
        confidence: probability that some sample has no outlier.
        max_samples: largest number of samples of five matches.
        model: "auto", or "essential" to skip model selection.
        kernel: of the final refinement of the essential matrix. With all but "truncated", its scale, the model
            selection and the search use the noise level estimated from the matches, the threshold only separates
            wrong matches, and the search counts matches behind a camera as wrong. With "truncated" the threshold
            sets all of that.
        weights: information of the matches; the threshold of a match is `threshold / sqrt(weight)`. A weight
            of zero, infinity or NaN excludes the match.
        min_samples: smallest number of samples of five matches.

    Returns:
        The relative poses.

    Raises:
        ValueError: A shape or a dtype does not fit, or an unknown model or kernel.
        RuntimeError: It is called within a transform of `torch.func`.
    """
    refuse_transforms("estimate_relative_pose")
    check_search(threshold, confidence, max_samples, min_samples)
    for name, value, known in (("model", model, _MODELS), ("kernel", kernel, _KERNELS)):
        if value not in known:
            raise ValueError(f"unknown {name} {value!r}; known are {', '.join(known)}")
    if 0 in pixels_1.shape or pixels_1.shape[1] < 5:
        given = pixels_1, pixels_2, camera_1.params, camera_2.params, *([] if weights is None else [weights])
        return _nothing(pixels_1, given)
    finite = torch.isfinite(pixels_1).all(-1) & torch.isfinite(pixels_2).all(-1)
    finite = finite if weights is None else finite & (weights > 0) & torch.isfinite(weights)
    mask = finite if mask is None else mask & finite
    pixels_1, pixels_2 = (torch.where(mask[..., None], pixels, 0.0) for pixels in (pixels_1, pixels_2))
    inputs = [pixels_1, pixels_2, camera_1.params, camera_2.params, *([] if weights is None else [weights])]

    def views(
        pixels_1: Tensor, pixels_2: Tensor, params_1: Tensor, params_2: Tensor, weights: Tensor | None = None
    ) -> TwoViews:
        cameras = camera_1.with_params(params_1), camera_2.with_params(params_2)
        return TwoViews.of(pixels_1, pixels_2, *cameras, threshold, mask, weights)

    effort = confidence, min_samples, max_samples
    with torch.no_grad():
        detached = views(*(x.detach() for x in inputs))
        found = find_relative_pose(detached, weights, camera_2, threshold, kernel, model, seed, effort)
    T_21 = attach_relative_pose(found, views(*inputs), kernel) if needs_gradient(*inputs) else found.T_21
    return _answer(T_21, found)


def _answer(T_21: Float[Tensor, "B 4 4"], found: FoundPose) -> RelativePose:
    """The result, with a pose that may carry a gradient."""
    identity = torch.eye(4, dtype=T_21.dtype, device=T_21.device)
    return RelativePose(
        torch.where(found.significant[:, None, None], T_21, identity),
        found.inliers,
        found.significant & (found.model != ROTATION) & ~found.ambiguous,
        found.model,
        found.ambiguous & found.significant,
        found.scores[0],
        found.scores[1],
        found.scores[2],
        found.T_essential,
    )


def _nothing(pixels: Float[Tensor, "B N 2"], given: Sequence[Tensor]) -> RelativePose:
    """The answer where there is nothing to sample from."""
    B, N = pixels.shape[:2]
    T_21 = torch.eye(4, dtype=pixels.dtype, device=pixels.device).expand(B, 4, 4)
    score = torch.zeros(B, dtype=pixels.dtype, device=pixels.device)
    model = torch.full((B,), ROTATION, device=pixels.device)
    no = torch.zeros(B, N + 1, dtype=torch.bool, device=pixels.device)
    return RelativePose(
        with_zero_gradient(T_21, *given), no[:, :N], no[:, N], model, no[:, N], score, score, score, T_21
    )


def attach_relative_pose(found: FoundPose, views: TwoViews, kernel: Kernel) -> Float[Tensor, "B 4 4"]:
    """The poses found, with the gradient of the minimizer of the chosen model's errors over the rows in use."""
    T_21, normal, model, used = found.T_21, found.normal, found.model, found.used
    views = views.in_units(found.noise[:, None])
    R, t = T_21[:, :3, :3], T_21[:, :3, 3]
    # Parameters that the chosen model does not have must not bring NaN.
    forward = t.new_tensor((0.0, 0.0, 1.0))
    t = torch.where((model == ROTATION)[:, None] | (t == 0).all(-1, keepdim=True), forward, t)
    normal = torch.where((model == HOMOGRAPHY)[:, None], normal, forward)
    basis_t, basis_n = tangent_basis(t), tangent_basis(normal)
    variance_1, variance_2 = views.scale_1.square().reciprocal(), views.scale_2.square().reciprocal()
    weight = (variance_1 + variance_2).rsqrt()

    def direction(step: Tensor) -> Tensor:
        moved = t + (step[:, None] @ basis_t).squeeze(1)
        return moved / moved.norm(dim=-1, keepdim=True)

    def essential(step: Tensor) -> Tensor:
        E = essential_from_pose(so3_exp(step[:, :3]) @ R, direction(step[:, 3:]))
        squared = sampson_errors(E, views.x_1, views.x_2, variance_1, variance_2).square()
        if kernel != "truncated":
            squared = robustify(squared, kernel, squared.new_tensor(KERNEL_WIDTH)).rho
        return torch.where(used & (model == ESSENTIAL)[:, None], squared, 0.0).sum(-1)

    def mapping(H: Tensor, rows: Tensor) -> Tensor:
        error = transfer_errors(H, views.x_1, views.x_2).square().sum(-1) * weight.square()
        return torch.where(used & rows[:, None], error, 0.0).sum(-1)

    def homography(step: Tensor) -> Tensor:
        plane = normal * (1 + step[:, 5:6]) + (step[:, None, 6:] @ basis_n).squeeze(1)
        H = so3_exp(step[:, :3]) @ R + direction(step[:, 3:5])[:, :, None] * plane[:, None]
        return mapping(H, model == HOMOGRAPHY)

    def rotation(step: Tensor) -> Tensor:
        return mapping(so3_exp(step) @ R, model == ROTATION)

    steps = (
        implicit_step(essential, R.new_zeros(len(R), 5)),
        implicit_step(homography, R.new_zeros(len(R), 8))[:, :5],
        torch.nn.functional.pad(implicit_step(rotation, R.new_zeros(len(R), 3)), (0, 2)),
    )
    step = steps[0] + steps[1] + steps[2]
    moving = (T_21[:, :3, 3] != 0).any(-1, keepdim=True)
    return rigid(so3_exp(step[:, :3]) @ R, torch.where(moving, direction(step[:, 3:]), 0.0))
