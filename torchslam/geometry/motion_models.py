"""Selection among three models of two views: essential matrix, homography and pure rotation; and the pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.ransac import SUPPORT_WIDTH, best_of, count_distinct, is_significant, is_unlikely
from torchslam.geometry.robust import NORMAL_MEDIAN, NORMAL_SQUARED_MEDIAN_2D
from torchslam.geometry.two_view import (
    TRANSFER_WIDTH,
    TwoViews,
    ahead_and_parallax,
    fit_homography,
    fit_rotation,
    noise_variance,
    propose_homography,
    propose_rotation,
    sampson_squared,
    transfer_squared,
    twisted,
)
from torchslam.geometry.two_view_matrices import decompose_homography

MODELS = ("essential", "homography", "rotation")
ESSENTIAL, HOMOGRAPHY, ROTATION = range(3)
"""Rows of the models, in the order of `MODELS`."""

FINAL_ITERATIONS = 12
"""Of Levenberg-Marquardt, for the model that is chosen. Tried at this value only."""
FINAL_WIDTH = 2.0  # thresholds; the refinement uses the tail of the noise too
_HOMOGRAPHY_SAMPLES, _ROTATION_SAMPLES, _TRIAL_ITERATIONS = 64, 16, 5
"""Minimal samples of a homography and a rotation, and iterations for one that may not be needed. Tried at these values
only."""
_CLEARLY_OFF = 2.0  # thresholds of the transfer error: three deviations of noise as large as the threshold
# Deviations of the noise, in both images together, up to which matches may be one that is repeated. Tried at this value
# only.
_DISTINCT = 6.0
_LEAST_SPREAD = 3.0  # thresholds by which the inliers must leave a line
_LEAST_SHARE = 0.05  # of the matches that must contradict the simpler model for the richer one to be chosen
# A best sample of which this share of the matches is clearly off, of at least this many in all: no fit brings these
# below the share above. Among few matches an essential matrix has many inliers by accident.
_HOPELESS, _MANY = 0.25, 50
_FARTHEST = 3.0  # deviations of the noise, beyond which a match counts as so far off
# Alignment of the errors with the epipolar lines: by this many deviations, two more than a direction needs that was not
# chosen to fit; and on average as where the variance along the lines is twice that across, since the noise of keypoints
# on edges has a direction of its own.
_MIN_LEAN_SIGMAS, _MIN_LEAN = 4.0, 1 / 3
# Squared deviations by which the five parameters of an essential matrix, fitted, beat the true one in one case of a
# hundred (chi-square); and the median square of one Gaussian, over that of the length of two.
_GAIN_OF_A_FIT, _PLANE_MEDIAN = 15.09, NORMAL_MEDIAN**2 / NORMAL_SQUARED_MEDIAN_2D
# Ratio of the support of the second motion before a plane to that of the first, above which either may be the right
# one; and entries of two rotations that differ by less are those of one motion, to 0.06 degrees. Tried at these values
# only.
_MAX_SECOND_SUPPORT, _SAME_ROTATION = 0.8, 1e-3
_TELLS_MOTIONS = 3.0  # deviations by which one of two motions before a plane has to explain more
# Of the matches on a plane, which noise may turn over where it is seen edge on; and of those with parallax.
_IN_FRONT = 0.9
_EXACT = 1 / 16  # units of the noise; only exact matches are far below, and what is left of them is rounding


@dataclass(frozen=True)
class Fits:
    """The best fit of each model: the pose of the essential matrix, the homography, and the pure rotation.

    squared: errors of the three models, thresholds
    """

    R: Float[Tensor, "B 3 3"]
    t: Float[Tensor, "B 3"]
    H: Float[Tensor, "B 3 3"]
    R_only: Float[Tensor, "B 3 3"]
    squared: Float[Tensor, "3 B N"]

    def with_mappings(self, views: TwoViews) -> Fits:
        """Update the errors of homography and rotation."""
        mapped = transfer_squared(views, torch.stack((self.H, self.R_only), dim=1)).transpose(0, 1)
        return replace(self, squared=torch.cat((self.squared[:1], mapped)).nan_to_num(torch.inf))

    def finished(self, views: TwoViews, width: float) -> Fits:
        """Minimize homography and rotation over the matches within `width` thresholds."""
        (H,), _ = fit_homography(views, self.H[:, None], FINAL_ITERATIONS, width)
        (R_only,), _ = fit_rotation(views, self.R_only[:, None], FINAL_ITERATIONS, width)
        return replace(self, H=H[:, 0], R_only=R_only[:, 0]).with_mappings(views)


def fit_models(
    views: TwoViews,
    R: Float[Tensor, "B 3 3"],
    t: Float[Tensor, "B 3"],
    generator: torch.Generator,
    by_noise: bool = False,
) -> Fits:
    """A homography and a pure rotation for matches that R, t explain.

    by_noise: skip the fit of samples that most matches contradict, as in a scene with depth
    """
    essential = sampson_squared(views, R[:, None], t[:, None])[:, 0]
    # The matches of a plane, or of a pure rotation, are among those that fit the essential matrix.
    near = replace(views, mask=views.mask & (essential < SUPPORT_WIDTH**2))
    R_only = propose_rotation(near, _ROTATION_SAMPLES, generator)
    H = propose_homography(near, _HOMOGRAPHY_SAMPLES, generator)
    hopeless = torch.zeros_like(views.mask[:, 0])
    rough = Fits(R, t, H[:, 0], R_only[:, 0], essential.expand(3, -1, -1))
    if by_noise:
        rough = rough.with_mappings(views)
        noise = noise_variance(essential, views.mask).clamp_min(1.0)[:, None]
        off = ((rough.squared[1:] > _CLEARLY_OFF**2 * noise) & near.mask).sum(-1)
        count = near.mask.sum(-1)
        hopeless = (off > _HOPELESS * count.float()).all(0) & (count >= _MANY)
        if bool(hopeless.all()):
            return rough
    (R_only,), _ = best_of(*fit_rotation(views, R_only, _TRIAL_ITERATIONS, FINAL_WIDTH))
    H = torch.cat((H, (R_only / R_only[:, 2:, 2:])[:, None]), dim=1)
    (H,), _ = best_of(*fit_homography(views, H, _TRIAL_ITERATIONS, FINAL_WIDTH))
    fits = replace(rough, H=H, R_only=R_only).with_mappings(views)
    if not bool(hopeless.any()):
        return fits
    # Independent of the other elements of the batch.
    row = hopeless[:, None, None]
    H, R_only = torch.where(row, rough.H, fits.H), torch.where(row, rough.R_only, fits.R_only)
    return Fits(R, t, H, R_only, torch.where(hopeless[:, None], rough.squared, fits.squared))


def choose(
    views: TwoViews, fits: Fits, chance: Float[Tensor, " B"], by_noise: bool = False
) -> tuple[Int[Tensor, " B"], Bool[Tensor, " B"]]:
    """The index of the simplest model that no significant number of matches contradicts, and if a plane is one.

    by_noise: also require that all matches together do not contradict it by the direction of their errors. Keypoint
    noise has a long tail, so that many errors of a few pixels do not refute a rotation. But noise has any direction,
    while parallax lies along the epipolar lines, in one sense; noise along image edges can lie so in both senses.
    """
    mask, (essential, homography, rotation) = views.mask, fits.squared
    # Noise beyond the threshold must not look like parallax: the distances from the epipolar lines, which depth
    # does not touch, show how large it is.
    variance = noise_variance(essential, mask)
    noise = variance.clamp_min(1.0)[:, None]
    explained = (torch.minimum(essential, homography) < noise) & mask
    chance = chance * noise[:, 0].sqrt()

    def contradicted(simple: Float[Tensor, "B N"], rich: Float[Tensor, "B N"]) -> Bool[Tensor, " B"]:
        off = (simple > _CLEARLY_OFF**2 * noise) & mask
        against, count = (off & (rich < noise)).sum(-1), off.sum(-1)
        if by_noise:
            size = 2 if rich is essential else 3  # matches that fix what the richer model has more
            nearby = (noise / simple).nan_to_num().clamp_max(1.0)  # the share of a disc as wide as the error
            if rich is essential:
                nearby = 2 / math.pi * (nearby.sqrt() / TRANSFER_WIDTH).asin()  # of its directions
            nearby = torch.where(off, nearby, 0.0).sum(-1) / count.clamp_min(1)
            certain = is_unlikely(against, count, size, nearby.maximum(chance ** (size - 1)))
        else:
            certain = is_significant(against, count, 2, chance, 1)
        return certain & (against > _LEAST_SHARE * explained.sum(-1).float())

    off = torch.stack((contradicted(homography, essential), contradicted(rotation, essential)))
    if by_noise:
        off = (off | _leans(fits.squared, mask, variance)) & ~goes_both_ways(views, fits, variance)
        off[1] |= off[0] | contradicted(rotation, homography)  # it is the homography of a plane at infinity
    plane, still = ~off
    return torch.where(still, ROTATION, torch.where(plane, HOMOGRAPHY, ESSENTIAL)), plane


def _leans(
    squared: Float[Tensor, "3 B N"], mask: Bool[Tensor, "B N"], variance: Float[Tensor, " B"]
) -> Bool[Tensor, "2 B"]:
    """Whether the matches lie off homography and rotation along their epipolar lines, rather than anywhere.

    Little parallax is spread over all matches, none of which is clearly off. Noise, of whatever size and tail, has no
    direction: the cosine of twice the angle to the line is zero on average, and one half in square. Matches count by
    their squared distance, which is most powerful where parallax adds to Gaussian noise, up to that of `_FARTHEST`.

    squared: as of `Fits`; variance: variance of the noise, by the essential matrix
    """
    variance = variance.clamp_min(_EXACT**2)[:, None]
    across, both = squared[ESSENTIAL], squared[1:] * TRANSFER_WIDTH**2
    near = mask & (both < (2 * _FARTHEST) ** 2 * variance)
    weight = torch.where(near, (both / variance).clamp_max(_FARTHEST**2), 0.0)
    cosine = 1 - 2 * (across / both.clamp_min(torch.finfo(both.dtype).tiny)).clamp_max(1.0)
    lean = torch.where(near, weight * cosine, 0.0).sum(-1)
    # One more, that matches far below the noise, whose errors are rounding, are not enough.
    deviation = (0.5 * weight.square().sum(-1) + 1).sqrt()
    return (lean > _MIN_LEAN * weight.sum(-1)) & (lean > _MIN_LEAN_SIGMAS * deviation)


def goes_both_ways(views: TwoViews, fits: Fits, variance: Float[Tensor, " B"]) -> Bool[Tensor, " B"]:
    """Test whether a rotation explains most matches, and what parallax the essential matrix makes of them is noise.

    The noise of keypoints on edges lies along lines, and where many edges are parallel, along epipolar lines: parallax
    by its size. But it puts as many matches behind the cameras as before them.

    variance: of the noise, by the essential matrix
    """
    variance = variance.clamp_min(_EXACT**2)[:, None]
    near = views.mask & (fits.squared[ESSENTIAL] < _FARTHEST**2 * variance)
    still = near & (fits.squared[ROTATION] * TRANSFER_WIDTH**2 < _FARTHEST**2 * variance)
    mostly = 2 * still.sum(-1) > near.sum(-1)
    if not bool(mostly.any()):
        return mostly
    ahead, parallax = ahead_and_parallax(views, fits.R[:, None], fits.t[:, None])
    # The noise of both images is in it.
    clear = near & (parallax[:, 0] > _FARTHEST * (2 * variance).sqrt())
    return mostly & ((clear & ahead[:, 0]).sum(-1) < _IN_FRONT * clear.sum(-1).float())


class PlaneMotions(NamedTuple):
    """Motions in front of the plane of a homography, four for each: rotations, and directions of the translation.

    normal: of the plane, in units of the distance that the camera moved; squared: Sampson errors, thresholds; possible:
    whether the plane is in front of the cameras
    """

    R: Float[Tensor, "B 4 3 3"]
    direction: Float[Tensor, "B 4 3"]
    normal: Float[Tensor, "B 4 3"]
    squared: Float[Tensor, "B 4 N"]
    possible: Bool[Tensor, "B 4"]

    @staticmethod
    def of(views: TwoViews, fits: Fits) -> PlaneMotions:
        """Decompose the homographies."""
        R, t, normals = decompose_homography(fits.H)
        # All of the plane must be in front of the first camera, and then is in front of the second.
        plane = views.mask & (fits.squared[HOMOGRAPHY] < 1)
        ahead = ((views.h_1 @ normals.mT) > 0) & plane[..., None]
        share = ahead.sum(1).float() / plane.sum(1, keepdim=True).clamp_min(1)
        length = t.norm(dim=-1, keepdim=True)
        direction = t / length.clamp_min(1e-12)
        squared = sampson_squared(views, R, direction)
        return PlaneMotions(R, direction, normals * length, squared, share > _IN_FRONT)


def plane_holds(views: TwoViews, fits: Fits, plane: PlaneMotions) -> Bool[Tensor, " B"]:
    """Test whether a motion before the plane explains the matches about as well as the essential matrix does.

    Few matches, most of which lie near some plane, show their depth by too few others to be no accident. But as motions
    of a scene with depth the two can be compared by all matches, each up to three deviations: what the plane's leaves
    beyond the gain of a fit, it does not know.
    """
    # The noise as the plane has it, too: an essential matrix that accident chose shows too little.
    across, both = fits.squared[:2]
    of_plane = _PLANE_MEDIAN * noise_variance(both * TRANSFER_WIDTH**2, views.mask)
    variance = torch.maximum(noise_variance(across, views.mask), of_plane).clamp_min(_EXACT**2)[:, None]
    near = (torch.minimum(*fits.squared[:2]) < _FARTHEST**2 * variance) & views.mask

    def cost(squared: Float[Tensor, "B K N"]) -> Float[Tensor, "B K"]:
        whitened = (squared / variance[..., None]).nan_to_num(torch.inf).clamp_max(_FARTHEST**2)
        return torch.where(views.mask[:, None], whitened, 0.0).sum(-1)

    costs = cost(plane.squared).where(plane.possible, torch.inf)
    excess = costs.amin(-1) - cost(fits.squared[ESSENTIAL][:, None])[:, 0]
    return excess <= (_FARTHEST**2 * _LEAST_SHARE * near.sum(-1).float()).clamp_min(_GAIN_OF_A_FIT)


def pose_of(
    views: TwoViews,
    fits: Fits,
    front: tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]],
    model: Int[Tensor, " B"],
    plane: PlaneMotions,
    by_noise: bool = False,
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"], Float[Tensor, "B 3"], Bool[Tensor, " B"]]:
    """R, t and the normal of the plane, and whether a plane leaves two motions.

    front: R, t of the essential matrix; by_noise: two motions remain also if noise may be why one is better
    """
    R_H, direction, normal, squared, possible = plane
    of_match = torch.where(views.mask[:, None], (1 - squared).clamp_min(0.0), 0.0)
    support = torch.where(possible, of_match.sum(-1), -1.0)
    (first, second), (best, other) = (part.unbind(-1) for part in support.topk(2, dim=-1))
    ambiguous = second > _MAX_SECOND_SUPPORT * first.clamp_min(0.0)
    index = torch.arange(len(model), device=model.device)
    if by_noise:
        deviation = (of_match[index, best] - of_match[index, other]).norm(dim=-1)
        ambiguous |= (second >= 0) & (first - second < _TELLS_MOTIONS * deviation)
    flat, still = model == HOMOGRAPHY, model == ROTATION
    apart = (R_H[index, best] - R_H[index, other]).abs().amax((-2, -1)) > _SAME_ROTATION
    R = torch.where(flat[:, None, None], R_H[index, best], front[0])
    R = torch.where(still[:, None, None], fits.R_only, R)
    t = torch.where(flat[:, None], direction[index, best], front[1])
    return R, torch.where(still[:, None], 0.0, t), normal[index, best], flat & ambiguous & apart


def is_spread(views: TwoViews, inliers: Bool[Tensor, "B N"]) -> Bool[Tensor, " B"]:
    """Test whether the inliers leave a line in both images, by some thresholds."""
    weights = inliers[..., None].to(views.x_1.dtype)
    weights = weights / weights.sum(1, keepdim=True).clamp_min(1.0)
    spread = torch.ones_like(inliers[:, 0])
    for x, scale in ((views.x_1, views.scale_1), (views.x_2, views.scale_2)):
        centered = (x - (weights * x).sum(1, keepdim=True)) * scale[..., None]
        xx, xy, _, yy = ((weights * centered).mT @ centered).flatten(1).unbind(-1)
        smaller = 0.5 * (xx + yy) - (0.25 * (xx - yy).square() + xy.square()).sqrt()
        spread = spread & (smaller > _LEAST_SPREAD**2)
    return spread


def is_no_accident(
    views: TwoViews,
    squared: Float[Tensor, "B N"],
    model: Int[Tensor, " B"],
    noise: Float[Tensor, " B"],
    chance: Float[Tensor, " B"],
    by_noise: bool,
) -> Bool[Tensor, " B"]:
    """Test whether this number of matches, distributed as they are, cannot be within the threshold by chance.

    With `by_noise`, the range that the noise explains, often much less than the threshold, is tried as well; a
    rotation is determined by two matches, not five, and a wrong match is as near with less than the squared chance.

    views, squared errors: in units of the noise; chance: that a wrong match is within the threshold of a line
    """
    still = (model == ROTATION) & by_noise
    in_thresholds = views.in_units(1 / noise[:, None])
    places = torch.cat((views.x_1 * views.scale_1[..., None], views.x_2 * views.scale_2[..., None]), dim=-1)
    found = torch.zeros_like(still)
    for width in (1 / noise, torch.full_like(noise, FINAL_WIDTH))[: 1 + by_noise]:
        inliers = (squared < width.square()[:, None]) & views.mask
        count, available = count_distinct(places / _DISTINCT, inliers, views.mask.sum(-1))
        chances = chance * width * noise
        counted = is_significant(count, available, 5, chances, 10)
        if bool(still.any()):
            counted |= still & is_significant(count, available, 2, chances.square(), 1)
        found = found | (counted & is_spread(in_thresholds, inliers))
        if bool(found.all()):
            break
    return found


def in_front(
    views: TwoViews, R: Float[Tensor, "B 3 3"], t: Float[Tensor, "B 3"], inliers: Bool[Tensor, "B N"]
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]]:
    """The pose with most inliers in front of both cameras among the four of an essential matrix.

    A match counts by its parallax in thresholds, up to one: matches with little parallax do not determine depths.
    """
    R, t = twisted(R, t)
    is_ahead, parallax = ahead_and_parallax(views, R, t)
    weight = torch.where(inliers[:, None], parallax.clamp_max(1.0), 0.0)
    ahead = torch.where(is_ahead, weight, 0.0).sum(-1)
    best = ahead.argmax(-1)
    index = torch.arange(len(best), device=best.device)
    return R[index, best], t[index, best]
