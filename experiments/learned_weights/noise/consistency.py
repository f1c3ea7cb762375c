"""Whether the errors of keyframes are as large as their covariances: the normalized estimation error squared, NEES.

An estimate is known up to a similarity, and is aligned with the truth by one. What the seven free directions of the
alignment remove from the errors, they remove from the joint covariance of all positions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.geometry import se3_inverse, skew, transform, umeyama
from torchslam.geometry.gating import times
from torchslam.geometry.robust import Kernel, robustify
from torchslam.optim.run_graph import ObservationGraph

GAUGE = 7
_UNDETERMINED = 1e-12
"""Of the largest information: directions below it have no variance, nothing measures them."""


def nees(graph: ObservationGraph, T_cw: Tensor, known: Tensor, bend: float) -> float:
    """Mean over keyframes of e^T C^-1 e / 3: 1 where covariances are right, more where they are too small.

    e is the error of an aligned position; C its covariance by the weights of the graph, which are taken for true
    inverse covariances: unlike in `BundleSolution.covariance`, residuals calibrate nothing.

    graph: keyframes alone, at its minimum; T_cw: (K, 4, 4) true poses, known: (K,) where they are known
    bend: of the Huber kernel
    """
    covariance = inverse_information(reduced_information(graph, bend))
    return float(normalized_squares(graph.T_cw, T_cw, known, covariance).mean())


def normalized_squares(
    T_cw: Tensor, T_cw_true: Tensor, known: Tensor, covariance: Tensor, truth_m: float = 0.0
) -> Tensor:
    """(k,) e^T C^-1 e / 3 of the aligned positions of the k known keyframes.

    covariance: (6 K, 6 K) of the left perturbations of T_cw; truth_m: standard deviation of a true position
    """
    errors, scale = aligned_errors(T_cw, T_cw_true, known)
    removed = similarity_directions(T_cw, known)
    joint = aligned_covariance(T_cw, known, covariance)
    eye = torch.eye(len(joint), dtype=joint.dtype)
    joint = joint + (truth_m / scale) ** 2 * (eye - removed @ removed.mT)
    blocks = joint.unflatten(0, (-1, 3)).unflatten(-1, (-1, 3)).diagonal(dim1=0, dim2=2).movedim(-1, 0)
    return (errors * torch.linalg.solve(blocks, errors)).sum(-1) / 3


def aligned_errors(T_cw: Tensor, T_cw_true: Tensor, known: Tensor) -> tuple[Tensor, float]:
    """(k, 3) errors of the positions of the known keyframes in map units after alignment, and meters per unit."""
    positions, truth = (se3_inverse(T)[known, :3, 3] for T in (T_cw, T_cw_true))
    s, R, t = umeyama(positions, truth)
    return positions - (truth - t) @ R / s, float(s)


def similarity_directions(T_cw: Tensor, known: Tensor) -> Tensor:
    """(3 k, 7) orthonormal directions of the positions along which a similarity moves them."""
    centers = se3_inverse(T_cw)[known, :3, 3]
    centers = centers - centers.mean(0)
    eye = torch.eye(3, dtype=centers.dtype).expand(len(centers), 3, 3)
    return torch.linalg.qr(torch.cat((eye, skew(centers), centers[:, :, None]), dim=-1).flatten(0, 1)).Q


def aligned_covariance(T_cw: Tensor, known: Tensor, covariance: Tensor) -> Tensor:
    """(3 k, 3 k) joint covariance of the positions of the k known keyframes after alignment by a similarity.

    covariance: (6 K, 6 K) of the left perturbations, in any gauge
    """
    count, rows = len(T_cw), torch.arange(len(T_cw))
    to_positions = covariance.new_zeros(count, 3, count, 6)
    to_positions[rows, :, rows, :3] = -T_cw[:, :3, :3].mT
    A = to_positions[known].flatten(0, 1).flatten(1)
    Q = similarity_directions(T_cw, known)
    A = A - Q @ (Q.mT @ A)
    return A @ covariance @ A.mT


def inverse_information(information: Tensor) -> Tensor:
    """The covariance of poses, with none along the directions that nothing measures."""
    values, vectors = torch.linalg.eigh(information)
    is_open = (torch.arange(len(values)) < GAUGE) | (values < _UNDETERMINED * values[-1])
    return vectors * torch.where(is_open, 0.0, 1 / values) @ vectors.mT


def reduced_information(graph: ObservationGraph, bend: float, kernel: Kernel = "huber") -> Tensor:
    """(6 K, 6 K) information of the left perturbations of K keyframes by robust weights, points eliminated."""
    T_cw, points_w = graph.T_cw[graph.frame_index], graph.points_w[graph.point_index]
    points_c = transform(T_cw, points_w[:, None])[:, 0]
    pixels, valid, J_c = graph.camera.project_with_point_jacobians(points_c)
    errors, weights = (pixels - graph.pixels)[..., None], graph.weights
    if weights.ndim == 1:
        weights = weights[:, None, None] * torch.eye(2, dtype=weights.dtype)
    squared = (errors.mT @ weights @ errors)[:, 0, 0]
    robust = robustify(squared, kernel, squared.new_tensor(bend)).weight
    W = times(weights, torch.where(valid, robust, 0.0))
    J_f, J_p = torch.cat((J_c, -J_c @ skew(points_c)), dim=-1), J_c @ T_cw[:, :3, :3]
    K, N = len(graph.T_cw), len(graph.points_w)
    U = W.new_zeros(K, 6, 6).index_add(0, graph.frame_index, J_f.mT @ W @ J_f)
    V = W.new_zeros(N, 3, 3).index_add(0, graph.point_index, J_p.mT @ W @ J_p)
    root, failed = torch.linalg.cholesky_ex(V)
    seen = ((torch.bincount(graph.point_index, minlength=N) >= 2) & (failed == 0))[:, None, None]
    coupling = W.new_zeros(N, 3, K, 6)
    coupling[graph.point_index, :, graph.frame_index] = J_p.mT @ W @ J_f
    coupling = torch.where(seen, coupling.flatten(2), 0.0)
    root = torch.where(seen, root, torch.eye(3, dtype=V.dtype))
    eliminated = torch.linalg.solve_triangular(root, coupling, upper=False).flatten(0, 1)
    return torch.block_diag(*U) - eliminated.mT @ eliminated
