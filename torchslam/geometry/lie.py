"""SO(3), SE(3) and Sim(3): exponential, logarithm, adjoint, interpolation, quaternions.

Tangent vectors put translation first: (3,) omega for SO(3), (6,) [rho, omega] for SE(3), (7,) [rho, omega,
sigma] for Sim(3), where exp(sigma) is the scale. Perturbations act from the left: exp(xi) @ T. Everything is
differentiable, also at the identity and at rotations by pi. Source: Sola et al., "A micro Lie theory for
state estimation in robotics", 2018; Eade, "Lie groups for 2D and 3D transformations", 2017.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry.precision import full_precision

# For small angles the coefficients come from their series, (-1)^k / (2k + n)! for n = 1, 2, 3, 4.
_SERIES = tuple(tuple((-1.0) ** k / math.factorial(2 * k + n) for n in (1, 2, 3, 4)) for k in range(7))
"""Seven terms: the next one is below the rounding of float64 at a squared angle of 0.25."""


def _rodrigues(angle_squared: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3, (cos a - 1 + a^2/2)/a^4 as smooth functions of a^2."""
    x = angle_squared[..., None]
    small = x < 0.25
    near, far = torch.where(small, x, 0.0), torch.where(small, 1.0, x)
    coefficients = torch.tensor(_SERIES, dtype=x.dtype, device=x.device)
    series = coefficients[6] * near + coefficients[5]
    for k in range(4, -1, -1):
        series = series * near + coefficients[k]
    angle = far.sqrt()
    half_sine = (0.5 * angle).sin()
    a, b = angle.sin() / angle, 2 * half_sine * half_sine / far
    closed = torch.cat((a, b, (1 - a) / far, (0.5 - b) / far), dim=-1)
    a, b, c, d = torch.where(small, series, closed).unbind(-1)
    return a, b, c, d


@full_precision
def skew(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix of the cross product: skew(v) @ u = v x u."""
    shape = (*v.shape, 3)
    return torch.linalg.cross(
        v[..., None].expand(shape), torch.eye(3, dtype=v.dtype, device=v.device).expand(shape), dim=-2
    )


@full_precision
def vee(W: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """The vector of the antisymmetric part of a matrix, the inverse of `skew`."""
    return 0.5 * torch.stack(
        (W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]), dim=-1
    )


@full_precision
def rigid(R: Float[Tensor, "*#batch 3 3"], t: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 4 4"]:
    """Homogeneous matrix [R t; 0 1]."""
    if R.shape[:-2] != t.shape[:-1]:
        shape = torch.broadcast_shapes(R.shape[:-2], t.shape[:-1])
        R, t = R.expand(*shape, 3, 3), t.expand(*shape, 3)
    bottom = torch.tensor((0.0, 0.0, 0.0, 1.0), dtype=R.dtype, device=R.device).expand(*t.shape[:-1], 1, 4)
    return torch.cat((torch.cat((R, t[..., None]), dim=-1), bottom), dim=-2)


@full_precision
def transform(
    T: Float[Tensor, "*#batch R 4"], points: Float[Tensor, "*#batch N 3"]
) -> Float[Tensor, "*#batch N 3"]:
    """Points under homogeneous transforms, whose last row may be left out."""
    return points @ T[..., :3, :3].mT + T[..., None, :3, 3]


def homogeneous(x: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch D+1"]:
    """Coordinates with a one behind them."""
    return torch.cat((x, torch.ones_like(x[..., :1])), dim=-1)


@full_precision
def so3_exp(omega: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of rotation vectors in radians."""
    a, b, _, _ = _rodrigues((omega * omega).sum(-1)[..., None, None])
    W = skew(omega)
    return torch.eye(3, dtype=omega.dtype, device=omega.device) + a * W + b * (W @ W)


@lru_cache(maxsize=16)
def identity(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "D D"]:
    """Identity matrix, cached."""
    return torch.eye(size, dtype=dtype, device=device)


@lru_cache(maxsize=16)
def generators(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 3 3"]:
    """The generators of SO(3), cached."""
    return skew(torch.eye(3, dtype=dtype, device=device))


def cayley_rotation(omega: Float[Tensor, "B 3"]) -> Float[Tensor, "B 3 3"]:
    """Rotation of the Cayley map: exp(omega) to second order, and cheaper."""
    W = (omega @ generators(omega.dtype, omega.device).view(3, 9)).view(-1, 3, 3)
    factor = 1 / (1 + 0.25 * (omega * omega).sum(-1))[:, None, None]
    turn = torch.baddbmm(W, W, W, alpha=0.5)  # W + W^2 / 2
    return torch.addcmul(identity(3, omega.dtype, omega.device), factor, turn)


@full_precision
def so3_left_jacobian(omega: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """J with exp(omega + d) = exp(J d) exp(omega) to first order."""
    _, b, c, _ = _rodrigues((omega * omega).sum(-1)[..., None, None])
    W = skew(omega)
    return torch.eye(3, dtype=omega.dtype, device=omega.device) + b * W + c * (W @ W)


@full_precision
def so3_double_integral(omega: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The integral of exp(u omega) over u in [0, s], and that over s in [0, 1]; half the identity for no rotation."""
    _, _, c, d = _rodrigues((omega * omega).sum(-1)[..., None, None])
    W = skew(omega)
    return 0.5 * torch.eye(3, dtype=omega.dtype, device=omega.device) + c * W + d * (W @ W)


@full_precision
def so3_left_jacobian_inverse(omega: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Inverse of the left Jacobian, for angles below 2 pi."""
    _, b, c, d = _rodrigues((omega * omega).sum(-1)[..., None, None])
    W = skew(omega)
    factor = (c - 2 * d) / (2 * b)  # (1 - (a/2) cot(a/2)) / a^2 without cancellation
    return torch.eye(3, dtype=omega.dtype, device=omega.device) - 0.5 * W + factor * (W @ W)


@full_precision
def quaternion_from_matrix(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (x, y, z, w) with w >= 0 of rotation matrices.

    The columns of 4 q q^T are linear in R; the one with the largest diagonal is never near zero (Shepperd, 1978).
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R.flatten(-2).unbind(-1)
    xy, xz, yz = r01 + r10, r02 + r20, r12 + r21
    xw, yw, zw = r21 - r12, r02 - r20, r10 - r01
    xx, yy, zz = 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22
    ww = 1 + r00 + r11 + r22
    outer = torch.stack((xx, xy, xz, xw, xy, yy, yz, yw, xz, yz, zz, zw, xw, yw, zw, ww), dim=-1)
    outer = outer.unflatten(-1, (4, 4))
    largest = outer.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = outer.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., 3:] < 0, -q, q)


@full_precision
def matrix_from_quaternion(q_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions (x, y, z, w) of any non-zero length."""
    v, w = q_xyzw[..., :3], q_xyzw[..., 3:, None]
    twice = 2 / (q_xyzw * q_xyzw).sum(-1)[..., None, None]
    V = skew(v)
    return torch.eye(3, dtype=v.dtype, device=v.device) + twice * (w * V + V @ V)


@full_precision
def so3_log(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vectors, in radians, of length at most pi, of rotation matrices."""
    v, w = quaternion_from_matrix(R).split((3, 1), dim=-1)
    sine_squared = (v * v).sum(-1, keepdim=True)
    small = sine_squared < 1e-3
    sine = torch.where(small, 1.0, sine_squared).sqrt()
    far = 2 * torch.atan2(sine, w) / sine
    cosine = torch.where(small, w, 1.0)
    x = torch.where(small, sine_squared, 0.0) / (cosine * cosine)  # tan^2 of half the angle
    near = 1 / 13 - x / 15
    for k in (11, 9, 7, 5, 3, 1):  # atan(y)/y = 1 - y^2/3 + y^4/5 - ...
        near = 1 / k - x * near
    near = 2 * near / cosine
    return torch.where(small, near, far) * v


@full_precision
def se3_exp(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Rigid transforms of tangent vectors [rho, omega]."""
    rho, omega = xi.split(3, dim=-1)
    a, b, c, _ = _rodrigues((omega * omega).sum(-1)[..., None, None])
    W = skew(omega)
    W2 = W @ W
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    V = eye + b * W + c * W2
    return rigid(eye + a * W + b * W2, (V @ rho[..., None]).squeeze(-1))


@full_precision
def se3_exp_transform(
    xi: Float[Tensor, "*#batch 6"], points: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Points under exp(xi), one each, in half the time of `transform` with the matrices."""
    rho, omega = xi.split(3, dim=-1)
    a, b, c, _ = _rodrigues((omega * omega).sum(-1, keepdim=True))
    turned, moved = torch.linalg.cross(omega, points), torch.linalg.cross(omega, rho)
    return points + rho + a * turned + b * moved + torch.linalg.cross(omega, b * turned + c * moved)


@full_precision
def se3_log(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """Tangent vectors [rho, omega] of rigid transforms."""
    omega = so3_log(T[..., :3, :3])
    rho = (so3_left_jacobian_inverse(omega) @ T[..., :3, 3:]).squeeze(-1)
    return torch.cat((rho, omega), dim=-1)


@full_precision
def se3_inverse(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Inverse of rigid transforms."""
    R = T[..., :3, :3].mT
    return rigid(R, -(R @ T[..., :3, 3:]).squeeze(-1))


@full_precision
def se3_adjoint(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6 6"]:
    """Ad with T exp(xi) = exp(Ad xi) T."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    top = torch.cat((R, skew(t) @ R), dim=-1)
    return torch.cat((top, torch.cat((torch.zeros_like(R), R), dim=-1)), dim=-2)


@full_precision
def se3_interpolate(
    T_0: Float[Tensor, "*#batch 4 4"],
    T_1: Float[Tensor, "*#batch 4 4"],
    fraction: Float[Tensor, "*#batch"] | float,
) -> Float[Tensor, "*#batch 4 4"]:
    """The screw motion from T_0 (fraction 0) to T_1 (fraction 1); that of the inverses is its inverse."""
    fraction = torch.as_tensor(fraction, dtype=T_0.dtype, device=T_0.device)
    return se3_exp(fraction[..., None] * se3_log(T_1 @ se3_inverse(T_0))) @ T_0


def _integration_matrix(nodes: np.ndarray) -> np.ndarray:
    """M with M @ f(nodes) = the integrals of f from 0 to each node, for nodes on [-1, 1] that stand for [0, 1]."""
    size = len(nodes)
    primitives = np.polynomial.legendre.legint(np.eye(size), lbnd=-1, scl=0.5)
    values = np.polynomial.legendre.legval(nodes, primitives).T
    return values @ np.linalg.inv(np.polynomial.legendre.legvander(nodes, size - 1))


# Gauss-Legendre nodes and weights on [0, 1]; 16 of them integrate the scaled rotation below to 1e-15.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_PARTIAL_WEIGHTS = _integration_matrix(_NODES).tolist()
_NODES, _WEIGHTS = (0.5 * (_NODES + 1)).tolist(), (0.5 * _WEIGHTS).tolist()  # from [-1, 1] to [0, 1]


def _sim3_translation_matrix(
    omega: Float[Tensor, "*batch 3"], sigma: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3 3"]:
    """W = integral over s in [0, 1] of exp(s sigma) exp(s omega^); quadrature is smooth for a small angle or scale."""
    s = torch.tensor(_NODES, dtype=omega.dtype, device=omega.device)
    weight = torch.tensor(_WEIGHTS, dtype=omega.dtype, device=omega.device) * (s * sigma[..., None]).exp()
    a, b, _, _ = _rodrigues(s * s * (omega * omega).sum(-1, keepdim=True))
    identity, linear, quadratic = weight.sum(-1), (weight * s * a).sum(-1), (weight * s * s * b).sum(-1)
    W = skew(omega)
    eye = torch.eye(3, dtype=omega.dtype, device=omega.device)
    return (
        identity[..., None, None] * eye + linear[..., None, None] * W + quadratic[..., None, None] * (W @ W)
    )


@full_precision
def sim3_exp(xi: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 4 4"]:
    """Similarities [sR t; 0 1] of tangent vectors [rho, omega, sigma], s = exp(sigma)."""
    rho, omega, sigma = xi[..., :3], xi[..., 3:6], xi[..., 6]
    t = (_sim3_translation_matrix(omega, sigma) @ rho[..., None]).squeeze(-1)
    return rigid(sigma.exp()[..., None, None] * so3_exp(omega), t)


@full_precision
def sim3_scale(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch"]:
    """The scale s of similarities [sR t; 0 1]."""
    return T[..., 0, :3].norm(dim=-1)


@full_precision
def sim3_log(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 7"]:
    """Tangent vectors [rho, omega, sigma] of similarities."""
    scale = sim3_scale(T)
    sigma, omega = scale.log(), so3_log(T[..., :3, :3] / scale[..., None, None])
    W = _sim3_translation_matrix(omega, sigma)
    rho = torch.linalg.solve_ex(W, T[..., :3, 3:])[0].squeeze(-1)
    return torch.cat((rho, omega, sigma[..., None]), dim=-1)


@full_precision
def sim3_inverse(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Inverse of similarities."""
    inverse = T[..., :3, :3].mT / sim3_scale(T).square()[..., None, None]
    return rigid(inverse, -(inverse @ T[..., :3, 3:]).squeeze(-1))


@full_precision
def sim3_adjoint(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 7 7"]:
    """Ad with T exp(xi) = exp(Ad xi) T for similarities."""
    sR, t = T[..., :3, :3], T[..., :3, 3]
    R = sR / sim3_scale(T)[..., None, None]
    return _sim3_matrix(sR, skew(t) @ R, -t, R)


@full_precision
def sim3_left_jacobian(xi: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 7 7"]:
    """J with exp(xi + d) = exp(J d) exp(xi) to first order."""
    (W, Q, q), rotation = _sim3_left_jacobian_blocks(xi)
    return _sim3_matrix(W, Q, -q, rotation)


@full_precision
def sim3_left_jacobian_inverse(xi: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 7 7"]:
    """Inverse of the left Jacobian, for angles below 2 pi."""
    (W, Q, q), _ = _sim3_left_jacobian_blocks(xi)
    rotation = so3_left_jacobian_inverse(xi[..., 3:6])
    W = torch.linalg.inv_ex(W)[0]
    return _sim3_matrix(W, -W @ Q @ rotation, (W @ q[..., None]).squeeze(-1), rotation)


def _sim3_left_jacobian_blocks(
    xi: Float[Tensor, "*batch 7"],
) -> tuple[
    tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]],
    Float[Tensor, "*batch 3 3"],
]:
    """W, Q, q and the rotation's Jacobian of J = [W Q -q; 0 J_rotation 0; 0 0 1].

    J is the integral over s in [0, 1] of Ad(exp(s xi)), that is, of [e^(s sigma) R(s), t(s)^ R(s), -t(s); ...], where
    t(s) itself is the integral of e^(u sigma) R(u) rho over u in [0, s]. All by the quadrature of `sim3_exp`, in the
    coefficients of I, omega^ and omega^ omega^.
    """
    rho, omega, sigma = xi[..., :3], xi[..., 3:6], xi[..., 6:]
    s, weights, partial = (
        torch.tensor(values, dtype=xi.dtype, device=xi.device)
        for values in (_NODES, _WEIGHTS, _PARTIAL_WEIGHTS)
    )
    a, b, _, _ = _rodrigues(s * s * (omega * omega).sum(-1, keepdim=True))
    turn = torch.stack((torch.ones_like(a), s * a, s * s * b), dim=-2)
    grow = turn * (s * sigma).exp()[..., None, :]
    traveled = weights * (grow @ partial.mT)
    around = torch.linalg.cross(omega, rho)
    spanned = torch.stack((rho, around, torch.linalg.cross(omega, around)), dim=-2)
    moments = (traveled @ turn.mT).mT @ spanned  # of t(s), with the coefficients of R(s)

    S = skew(omega)
    powers = torch.stack((torch.eye(3, dtype=xi.dtype, device=xi.device).expand_as(S), S, S @ S), dim=-3)
    W, rotation = (((f @ weights)[..., None, None] * powers).sum(-3) for f in (grow, turn))
    return (W, (skew(moments) @ powers).sum(-3), moments[..., 0, :]), rotation


def _sim3_matrix(
    W: Float[Tensor, "*batch 3 3"],
    Q: Float[Tensor, "*batch 3 3"],
    q: Float[Tensor, "*batch 3"],
    rotation: Float[Tensor, "*batch 3 3"],
) -> Float[Tensor, "*batch 7 7"]:
    """[W Q q; 0 rotation 0; 0 0 1]."""
    top = torch.cat((W, Q, q[..., None]), dim=-1)
    middle = torch.nn.functional.pad(rotation, (3, 1))
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 6] = 1.0
    return torch.cat((top, middle, bottom), dim=-2)
