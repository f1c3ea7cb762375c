"""A camera that only rotates, whose focal length and distortion are uncertain.

With a wrong camera, no rotation explains the matches of a camera that turned, and a translation or a plane may seem to.
A rotation with another camera then explains them as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.camera_measurement import FOCAL, K1, intrinsics_directions, with_radial_terms
from torchslam.geometry.lie import cayley_rotation, generators
from torchslam.geometry.precision import full_precision
from torchslam.geometry.ransac import ModelState, best_of, levenberg_marquardt
from torchslam.geometry.robust import robustify

_STARTS = 3  # focal lengths, over twice the standard deviation to both sides; the best result counts
_ITERATIONS = 10
"""Of Levenberg-Marquardt from each start. Tried at this value only."""
_KERNEL_SCALE = 2.0  # thresholds at which the Huber kernel becomes linear
_BEHIND = 1e3  # squared thresholds: the cost of a match that turns behind the camera


@dataclass(frozen=True)
class RotatingCamera:
    """Cameras that turned between two views.

    Attributes:
        R_21: rotations from view 1 to view 2.
        camera: the B cameras, each of both views.
        departure: of the focal length or of k1, whichever is larger, from the given one, in standard deviations.
        errors_px: pixels between the matches in view 2 and where those of view 1 turn to; infinite behind the camera.
    """

    R_21: Float[Tensor, "B 3 3"]
    camera: Camera
    departure: Float[Tensor, " B"]
    errors_px: Float[Tensor, "B N"]


@full_precision
def fit_rotating_camera(
    pixels_1: Float[Tensor, "B N 2"],
    pixels_2: Float[Tensor, "B N 2"],
    camera: Camera,
    std: float,
    threshold: float,
    mask: Bool[Tensor, "B N"],
) -> RotatingCamera:
    """Fit a rotation, a focal length and k1 to the matches of two views, few of which may be wrong.

    Minimizes the Huber cost of the errors in view 2 and of the departure from the given camera, by Levenberg-Marquardt
    from several focal lengths. Not differentiable by design: it serves a decision.

    Args:
        pixels_1: matches in view 1.
        pixels_2: matches in view 2.
        camera: of both views, one.
        std: relative standard deviation of its focal length, and of k1; above zero.
        threshold: pixels, about the noise of one coordinate or somewhat more.
        mask: matches in use.
    """
    given = with_radial_terms(camera)
    axes = generators(given.params.dtype, given.params.device)
    directions = std * intrinsics_directions(given, [FOCAL, K1])

    def factor(change: Float[Tensor, "B 2"]) -> Float[Tensor, "B 1"]:
        return (std * change[:, :1]).exp()

    def changed(change: Float[Tensor, "B 2"]) -> Camera:
        """The camera after a change of the logarithm of its focal length and of k1, in standard deviations."""
        focal, others = (
            given.params[:2] * factor(change),
            given.params[2:] + directions[2:, 1] * change[:, 1:],
        )
        return given.with_params(torch.cat((focal, others), dim=-1))

    def evaluate(R: Float[Tensor, "B 3 3"], change: Float[Tensor, "B 2"]) -> tuple[Tensor, Tensor]:
        at = changed(change)
        h_1, h_2 = _turned(R, at, pixels_1)
        along = (directions * torch.nn.functional.pad(factor(change), (0, 1), value=1.0)[:, None])[:, None]
        # The image points of fixed pixels move with the camera: 0 = J_point dx + J_params dparams.
        _, _, J_point, J_params = at.project_with_jacobians(h_1)
        moves = -torch.linalg.solve_ex(J_point[..., :2], J_params @ along)[0]
        pixels, valid, J_point, J_params = at.project_with_jacobians(h_2)
        J_turn = J_point @ torch.einsum("aij,bnj->bnia", axes, h_2)
        J_camera = J_point @ (R[:, None, :, :2] @ moves) + J_params @ along
        residual = (pixels - pixels_2) / threshold
        robust = robustify(residual.square().sum(-1), "huber", residual.new_tensor(_KERNEL_SCALE))
        weight = torch.where(valid & mask, robust.weight, 0.0).sqrt()[..., None, None]
        rows = torch.cat((torch.cat((J_turn, J_camera), dim=-1) / threshold, residual[..., None]), dim=-1)
        prior = torch.nn.functional.pad(torch.diag_embed(torch.ones_like(change)), (3, 0))
        rows = torch.cat(
            ((weight * rows).flatten(1, 2), torch.cat((prior, change[..., None]), dim=-1)), dim=1
        )
        cost = torch.where(mask, torch.where(valid, robust.rho, _BEHIND), 0.0).sum(-1)
        return rows.mT @ rows, cost + change.square().sum(-1)

    def retract(state: ModelState, step: Float[Tensor, "B 5"]) -> ModelState:
        return cayley_rotation(step[:, :3]) @ state[0], state[1] + step[:, 3:]

    with torch.no_grad():
        B, focal = len(mask), torch.linspace(-2.0, 2.0, _STARTS, dtype=axes.dtype, device=axes.device)
        pixels_1, pixels_2, mask = (x.repeat_interleave(_STARTS, dim=0) for x in (pixels_1, pixels_2, mask))
        change = torch.nn.functional.pad(focal.repeat(B)[:, None], (0, 1))
        at = changed(change)
        start = _rotation_of_rays(at.unproject(pixels_1), at.unproject(pixels_2), mask), change
        found, cost = levenberg_marquardt(start, evaluate, retract, _ITERATIONS)
        (R, change), _ = best_of(tuple(x.unflatten(0, (B, -1)) for x in found), cost.unflatten(0, (B, -1)))
        at = changed(change)
        pixels, valid = at.project(_turned(R, at, pixels_1[::_STARTS])[1])
        errors = torch.where(valid, (pixels - pixels_2[::_STARTS]).norm(dim=-1), torch.inf)
        return RotatingCamera(R, at, change.abs().amax(-1), errors)


def _turned(
    R: Float[Tensor, "B 3 3"], camera: Camera, pixels_1: Float[Tensor, "B N 2"]
) -> tuple[Float[Tensor, "B N 3"], Float[Tensor, "B N 3"]]:
    """The image points of pixels, and where they turn to."""
    h_1 = torch.nn.functional.pad(camera.normalize(pixels_1), (0, 1), value=1.0)
    return h_1, h_1 @ R.mT


def _rotation_of_rays(
    rays_1: Float[Tensor, "B N 3"], rays_2: Float[Tensor, "B N 3"], mask: Bool[Tensor, "B N"]
) -> Float[Tensor, "B 3 3"]:
    """The rotations that bring rays closest to rays, in the sense of least squares."""
    U, _, Vh = torch.linalg.svd((rays_2 * mask[..., None]).mT @ rays_1)
    signs = torch.nn.functional.pad(torch.linalg.det(U @ Vh)[:, None], (2, 0), value=1.0)
    return (U * signs[:, None]) @ Vh
