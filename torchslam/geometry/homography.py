"""Homographies: from matches, into rotation, translation and plane, and their errors.

x_2 ~ H x_1 for matches in undistorted image coordinates; H = R + t n^T for points_2 = R points_1 + t on the plane
n^T points_1 = 1.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.precision import full_precision


@full_precision
def homography_from_matches(
    x_1: Float[Tensor, "*batch N 2"], x_2: Float[Tensor, "*batch N 2"]
) -> Float[Tensor, "*batch 3 3"]:
    """Compute homographies with H_33 = 1 of samples of four or more matches, in the algebraic least-squares sense.

    For samples of more than four, coordinates should be of order one. Source: Hartley and Zisserman, 2004, alg.
    4.1.

    Args:
        x_1: coordinates in view 1.
        x_2: coordinates in view 2.

    Returns:
        The homographies; degenerate samples (three points on a line) give zeros, or anything.
    """
    x, y = x_1.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    u, v = x_2.unbind(-1)
    row_u = torch.stack((x, y, one, zero, zero, zero, -u * x, -u * y), dim=-1)
    row_v = torch.stack((zero, zero, zero, x, y, one, -v * x, -v * y), dim=-1)
    A, b = torch.cat((row_u, row_v), dim=-2), torch.cat((u, v), dim=-1)[..., None]
    if x_1.shape[-2] > 4:
        A, b = A.mT @ A, A.mT @ b
    h = torch.linalg.solve_ex(A, b)[0].squeeze(-1).nan_to_num()
    return torch.cat((h, torch.ones_like(h[..., :1])), dim=-1).unflatten(-1, (3, 3))


@full_precision
def rotation_from_matches(
    rays_1: Float[Tensor, "*batch 2 3"], rays_2: Float[Tensor, "*batch 2 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Compute rotations that take two rays to two rays, exact for the first."""

    def frame(rays: Tensor) -> Tensor:
        a, b = rays.unbind(-2)
        normal = torch.linalg.cross(a, b, dim=-1)
        x, z = a / a.norm(dim=-1, keepdim=True), normal / normal.norm(dim=-1, keepdim=True)
        return torch.stack((x, torch.linalg.cross(z, x, dim=-1), z), dim=-1)

    return frame(rays_2) @ frame(rays_1).mT


@full_precision
def transfer_errors(
    H: Float[Tensor, "*#batch 3 3"], x_1: Float[Tensor, "*#batch N 2"], x_2: Float[Tensor, "*#batch N 2"]
) -> Float[Tensor, "*#batch N 2"]:
    """Compute differences H(x_1) - x_2, very large where H takes a point behind the camera.

    Args:
        H: homographies.
        x_1: coordinates in view 1.
        x_2: coordinates in view 2.
    """
    mapped = x_1 @ H[..., :2].mT + H[..., None, :, 2]
    depth = mapped[..., 2:]
    front = depth > torch.finfo(depth.dtype).eps
    return torch.where(front, mapped[..., :2] / torch.where(front, depth, 1.0) - x_2, 1e6)


@full_precision
def decompose_homography(
    H: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 4 3 3"], Float[Tensor, "*batch 4 3"], Float[Tensor, "*batch 4 3"]]:
    """Decompose homographies into the four motions and planes that explain them, two of which have the scene in front.

    Not differentiable by design. Source: Ma et al., "An invitation to 3-D vision", 2004, section 5.3.3.

    Args:
        H: of any scale and sign.

    Returns:
        R, t in units of the plane's distance, and unit normals n in the first camera: H ~ R + t n^T. A pure rotation
        has t = 0 and any normal.
    """
    with torch.no_grad():
        H = torch.where(torch.linalg.det(H)[..., None, None] < 0, -H, H)
        squares, V = torch.linalg.eigh((H.mT @ H).nan_to_num())
        middle = squares[..., 1].clamp_min(torch.finfo(H.dtype).tiny)
        H = H * middle.rsqrt()[..., None, None]
        low, high = squares[..., 0] / middle, squares[..., 2] / middle
        v_3, v_2, v_1 = V.unbind(-1)
        # u = a v_1 + b v_3 keeps its length under H; without spread, of a pure rotation, any direction does.
        share = ((1 - low) / (high - low).clamp_min(torch.finfo(H.dtype).eps)).clamp(0.0, 1.0)[..., None]
        a, b = share.sqrt(), (1 - share).sqrt()
        motions = [_motion(H, v_2, a * v_1 + sign * b * v_3) for sign in (1, -1)]
        R, t, n = (
            torch.stack(part, dim=-3 if i == 0 else -2) for i, part in enumerate(zip(*motions, strict=True))
        )
    return torch.cat((R, R), dim=-3), torch.cat((t, -t), dim=-2), torch.cat((n, -n), dim=-2)


def _motion(H: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """R, t, n from two orthonormal vectors in the plane whose lengths H keeps."""

    def frame(a: Tensor, b: Tensor) -> Tensor:
        return torch.stack((a, b, torch.linalg.cross(a, b, dim=-1)), dim=-1)

    n = torch.linalg.cross(v, u, dim=-1)
    R = frame((H @ v[..., None]).squeeze(-1), (H @ u[..., None]).squeeze(-1)) @ frame(v, u).mT
    return R, ((H - R) @ n[..., None]).squeeze(-1), n
