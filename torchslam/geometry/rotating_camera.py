"""A camera that only rotates, whose focal length, distortion and readout time are uncertain.

With a wrong camera, no rotation explains the matches of a camera that turned, and a translation or a plane may seem to.
A rotation with another camera then explains them as well. A rolling shutter does the same: its rows are exposed one
after the other, and the camera turns in between. Source: Hedborg et al., "Rolling shutter bundle adjustment", 2012.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.camera_measurement import FOCAL, K1, intrinsics_directions, with_radial_terms
from torchslam.geometry.lie import cayley_rotation, generators, homogeneous, so3_exp
from torchslam.geometry.precision import full_precision
from torchslam.geometry.ransac import ModelState, best_of, levenberg_marquardt
from torchslam.geometry.robust import robustify
from torchslam.geometry.rolling_shutter import row_fractions
from torchslam.geometry.similarity import nearest_rotation
from torchslam.geometry.two_view import TRANSFER_WIDTH, TwoViews, fit_rotation, propose_rotation

_STARTS = 3  # focal lengths, over twice the standard deviation to both sides; the best result counts
_ITERATIONS = 10
"""Of Levenberg-Marquardt from each start. Tried at this value only."""
_KERNEL_SCALE = 2.0  # thresholds at which the Huber kernel becomes linear
MAX_FOCAL_SIGMAS = 3.0
"""Largest departure from the focal length of the camera with which a rotation may explain the matches."""
MAX_CONTRADICTING_RATIO = 0.05
"""Ratio of the matches that may contradict a rotation with another focal length.

Of rendered rotations it is 0.01 or less, with any guess of the focal length and either ORB. Where two frames of real
sequences determine a map, it is 0.13 or more.
"""
READOUT_STD = 0.5
"""Standard deviation of the readout time about zero, in intervals between frames; it is below one. Tried at this value
only."""


@dataclass(frozen=True)
class RotatingCamera:
    """Cameras that turned between two views, by the rotation R_21.

    Attributes:
        readout: time between the first and the last row of an image, in the unit of the turns.
        readout_std: its standard deviation if matches are known to the threshold; without turns, that of the prior.
        departure: of the focal length or of k1, whichever is larger, from the given one, in standard deviations.
        errors_px: pixels between the matches in view 2 and where those of view 1 turn to; infinite behind the camera.
    """

    R_21: Float[Tensor, "B 3 3"]
    camera: Camera
    readout: Float[Tensor, " B"]
    readout_std: Float[Tensor, " B"]
    departure: Float[Tensor, " B"]
    errors_px: Float[Tensor, "B N"]

    def explains(self, mask: Bool[Tensor, "B N"], noise_px: float) -> Bool[Tensor, " B"]:
        """Whether the rotation explains the matches of a mask, which are known to `noise_px`."""
        # Errors in two dimensions, with the noise of both views.
        off = (self.errors_px > math.sqrt(2) * TRANSFER_WIDTH * noise_px) & mask
        is_near = off.sum(-1) <= MAX_CONTRADICTING_RATIO * mask.sum(-1)
        return is_near & (self.departure <= MAX_FOCAL_SIGMAS)


@full_precision
def fit_rotating_camera(
    pixels_1: Float[Tensor, "B N 2"],
    pixels_2: Float[Tensor, "B N 2"],
    camera: Camera,
    std: float,
    threshold: float,
    mask: Bool[Tensor, "B N"],
    turns: Float[Tensor, "B 2 3"] | None = None,
) -> RotatingCamera:
    """Fit a rotation, a focal length, k1 and a readout time to the matches of two views, few of which may be wrong.

    Minimizes the Huber cost of the errors in view 2 and of the departure from the given camera, by Levenberg-Marquardt
    from several focal lengths. Not differentiable by design: it serves a decision.

    Args:
        std: relative standard deviation of the focal length, and of k1; above zero.
        threshold: pixels, about the noise of one coordinate or somewhat more.
        turns: rotation vectors by which the camera turns at each view, from there on, in the interval between two
            frames; without them the shutter is global.
    """
    turns = pixels_1.new_zeros(len(mask), 2, 3) if turns is None else turns
    given = with_radial_terms(camera)
    axes = generators(given.params.dtype, given.params.device)
    directions = std * intrinsics_directions(given, [FOCAL, K1])

    def factor(change: Float[Tensor, "B 2"]) -> Float[Tensor, "B 1"]:
        return (std * change[:, :1]).exp()

    def changed(change: Float[Tensor, "B 2"]) -> Camera:
        """The camera after a change of the logarithm of its focal length and of k1, in standard deviations."""
        others = given.params[2:] + directions[2:, 1] * change[:, 1:]
        return given.with_params(torch.cat((given.params[:2] * factor(change), others), dim=-1))

    def image_points(
        R: Float[Tensor, "B 3 3"], at: Camera, readout: Float[Tensor, "B 1"]
    ) -> tuple[Float[Tensor, "B N 3 3"], Float[Tensor, "B N 3 3"], Tensor, Tensor, Tensor]:
        """Rotations to the middle row of view 2 and on to the row of the match; the image points before and after."""
        R_1, R_2 = (so3_exp(readout[..., None] * turn) for turn in row_turns)
        R_middle = R[:, None] @ R_1.mT
        h_1 = homogeneous(at.normalize(pixels_1))
        h_middle = _rotated(R_middle, h_1)
        return R_middle, R_2, h_1, h_middle, _rotated(R_2, h_middle)

    def evaluate(
        R: Float[Tensor, "B 3 3"], change: Float[Tensor, "B 2"], readout: Float[Tensor, "B 1"]
    ) -> tuple[Tensor, Tensor]:
        at = changed(change)
        R_middle, R_2, h_1, h_middle, h_2 = image_points(R, at, readout)
        along = (directions * homogeneous(factor(change))[:, None])[:, None]
        # The image points of fixed pixels move with the camera: 0 = J_point dx + J_params dparams.
        _, _, J_point, J_params = at.project_with_jacobians(h_1)
        moves = -torch.linalg.solve_ex(J_point[..., :2], J_params @ along)[0]
        pixels, valid, J_point, J_params = at.project_with_jacobians(h_2)
        J_middle = J_point @ R_2
        J_turn = J_middle @ torch.einsum("aij,bnj->bnia", axes, h_middle)
        J_camera = J_middle @ (R_middle[..., :2] @ moves) + J_params @ along
        turned_1, turned_2 = (torch.linalg.cross(t, h) for t, h in zip(row_turns, (h_1, h_2), strict=True))
        J_readout = J_point @ turned_2[..., None] - J_middle @ (R_middle @ turned_1[..., None])
        residual = (pixels - pixels_2) / threshold
        robust = robustify(residual.square().sum(-1), "huber", residual.new_tensor(_KERNEL_SCALE))
        weight = torch.where(valid & mask, robust.weight, 0.0).sqrt()[..., None, None]
        rows = torch.cat((J_turn, J_camera, J_readout), dim=-1) / threshold
        rows = (weight * torch.cat((rows, residual[..., None]), dim=-1)).flatten(1, 2)
        departures = torch.cat((change, readout / READOUT_STD), dim=-1)
        prior = torch.diag_embed(departures.new_tensor((1.0, 1.0, 1 / READOUT_STD)).expand_as(departures))
        prior = torch.cat((torch.nn.functional.pad(prior, (3, 0)), departures[..., None]), dim=-1)
        rows = torch.cat((rows, prior), dim=1)
        cost = torch.where(mask, torch.where(valid, robust.rho, 1e3), 0.0).sum(-1)
        return rows.mT @ rows, cost + departures.square().sum(-1)

    def retract(state: ModelState, step: Float[Tensor, "B 6"]) -> ModelState:
        return cayley_rotation(step[:, :3]) @ state[0], state[1] + step[:, 3:5], state[2] + step[:, 5:]

    with torch.no_grad():
        B, focal = len(mask), torch.linspace(-2.0, 2.0, _STARTS, dtype=axes.dtype, device=axes.device)
        row_turns = [
            row_fractions(pixels, camera.height)[..., None] * turn[:, None]
            for pixels, turn in zip((pixels_1, pixels_2), turns.unbind(1), strict=True)
        ]
        row_turns = [x.repeat_interleave(_STARTS, dim=0) for x in row_turns]
        pixels_1, pixels_2, mask = (x.repeat_interleave(_STARTS, dim=0) for x in (pixels_1, pixels_2, mask))
        change = torch.nn.functional.pad(focal.repeat(B)[:, None], (0, 1))
        at = changed(change)
        rays_1, rays_2 = at.unproject(pixels_1), at.unproject(pixels_2)
        R = nearest_rotation((rays_2 * mask[..., None]).mT @ rays_1)
        found, cost = levenberg_marquardt(
            (R, change, torch.zeros_like(change[:, :1])), evaluate, retract, _ITERATIONS
        )
        R, change, readout = found
        covariance, singular = torch.linalg.inv_ex(evaluate(*found)[0][:, :-1, :-1])
        readout_std = torch.where(singular == 0, covariance[:, -1, -1], torch.inf).sqrt()
        readout_std = readout_std.clamp_max(READOUT_STD)
        pixels, valid = changed(change).project(image_points(R, changed(change), readout)[-1])
        errors = torch.where(valid, (pixels - pixels_2).norm(dim=-1), torch.inf)
        each = tuple(x.unflatten(0, (B, -1)) for x in (R, change, readout[:, 0], readout_std, errors))
        (R, change, readout, readout_std, errors), _ = best_of(each, cost.unflatten(0, (B, -1)))
        return RotatingCamera(R, changed(change), readout, readout_std, change.abs().amax(-1), errors)


@full_precision
def rotation_between(
    pixels_1: Float[Tensor, "B N 2"], pixels_2: Float[Tensor, "B N 2"], camera: Camera, threshold: float
) -> Float[Tensor, "B 3 3"]:
    """The rotations from view 1 to view 2 that most matches support, as if the camera did not move."""
    with torch.no_grad():
        mask = torch.ones_like(pixels_1[..., 0], dtype=torch.bool)
        views = TwoViews.of(pixels_1, pixels_2, camera, camera, threshold, mask, None)
        R = propose_rotation(views, 16, torch.Generator().manual_seed(0))
        ((R,), _) = best_of(*fit_rotation(views, R, _ITERATIONS, _KERNEL_SCALE))
        return R


def _rotated(R: Float[Tensor, "B N 3 3"], rays: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
    return (R @ rays[..., None])[..., 0]
