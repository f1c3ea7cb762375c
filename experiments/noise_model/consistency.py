"""Are the errors of keyframes as large as their covariances say? Normalised estimation error squared, NEES.

An estimate is known up to a similarity, and is aligned to the truth by one. So are its covariances: what the seven
free directions of the alignment take out of the errors, they take out of the joint covariance of all positions too.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.geometry import se3_inverse, skew, transform
from torchslam.geometry.alignment import umeyama
from torchslam.geometry.robust import robustify
from torchslam.geometry.whitening import times
from torchslam.optim.run_graph import ObservationGraph

GAUGE = 7
_SCALE = 2.45  # of `solve`
_OPEN = 1e-12  # of the largest information: what is below is a frame that nothing determines


@dataclass(frozen=True)
class Consistency:
    """nees: mean over keyframes of e^T C^-1 e / 3, e the error of the aligned position and C its covariance; 1 where
    covariances are right, more where they are too small.
    nees_joint: e^T C^+ e / (3 K - 7) of all K keyframes together, which asks most of the motion between neighbours;
    ratio: of the sum of squared errors to the sum of variances: the squared ATE to what it should be
    """

    nees: float
    nees_joint: float
    ratio: float


def consistency(graph: ObservationGraph, T_cw: Tensor, known: Tensor) -> Consistency:
    """Of a solved graph of keyframes; T_cw: (K, 4, 4) true poses, known: (K,) where they are."""
    T_wc, truth = se3_inverse(graph.T_cw), se3_inverse(T_cw)[:, :3, 3]
    positions = T_wc[:, :3, 3]
    s, R, t = umeyama(positions[known], truth[known])
    # Errors in units of the map, in its directions.
    errors = positions[known] - (truth[known] - t) @ R / s
    covariance = aligned_covariance(graph, known)
    blocks = covariance.unflatten(0, (-1, 3)).unflatten(-1, (-1, 3)).diagonal(dim1=0, dim2=2).movedim(-1, 0)
    nees = (errors * torch.linalg.solve(blocks, errors)).sum(-1).mean() / 3
    values, vectors = torch.linalg.eigh(covariance)
    along = (vectors.mT @ errors.flatten())[GAUGE:]
    joint = (along.square() / values[GAUGE:]).mean()
    return Consistency(float(nees), float(joint), float(errors.square().sum() / covariance.trace()))


def aligned_covariance(graph: ObservationGraph, known: Tensor) -> Tensor:
    """(3 k, 3 k) of the positions of the k known keyframes, after alignment by a similarity."""
    information = reduced_information(graph)
    values, vectors = torch.linalg.eigh(information)
    is_open = (torch.arange(len(values)) < GAUGE) | (values < _OPEN * values[-1])
    inverse = torch.where(is_open, 0.0, 1 / values)
    spread = vectors * inverse @ vectors.mT
    R_wc, count = graph.T_cw[:, :3, :3].mT, len(graph.T_cw)
    to_positions = spread.new_zeros(count, 3, count, 6)
    rows = torch.arange(count)
    to_positions[rows, :, rows, :3] = -R_wc
    A = to_positions[known].flatten(0, 1).flatten(1)
    centres = se3_inverse(graph.T_cw)[known, :3, 3]
    centres = centres - centres.mean(0)
    eye = torch.eye(3, dtype=centres.dtype).expand(len(centres), 3, 3)
    moves = torch.cat((eye, skew(centres), centres[:, :, None]), dim=-1).flatten(0, 1)
    Q = torch.linalg.qr(moves).Q
    A = A - Q @ (Q.mT @ A)
    return A @ spread @ A.mT


def reduced_information(graph: ObservationGraph) -> Tensor:
    """(6 K, 6 K) of the left perturbations of K keyframes, points eliminated; robust, calibrated by the residuals."""
    points_w, frames = graph.points_w[graph.point_index], graph.T_cw[graph.frame_index]
    points_c = transform(frames, points_w[:, None])[:, 0]
    pixels, valid, J_c = graph.camera.project_with_point_jacobians(points_c)
    errors = pixels - graph.pixels
    weights = graph.weights
    if weights.ndim == 1:
        weights = weights[:, None, None] * torch.eye(2, dtype=weights.dtype)
    squared = (errors[:, None] @ weights @ errors[..., None])[:, 0, 0]
    robust = robustify(squared, "huber", squared.new_tensor(_SCALE))
    W = times(weights, torch.where(valid, robust.weight, 0.0))
    J_f = torch.cat((J_c, -J_c @ skew(points_c)), dim=-1)
    J_p = J_c @ frames[:, :3, :3]
    K, P = len(graph.T_cw), len(graph.points_w)
    U = W.new_zeros(K, 6, 6).index_add(0, graph.frame_index, J_f.mT @ W @ J_f)
    V = W.new_zeros(P, 3, 3).index_add(0, graph.point_index, J_p.mT @ W @ J_p)
    H = torch.block_diag(*U)
    seen = torch.bincount(graph.point_index, minlength=P) >= 2
    eye = torch.eye(3, dtype=V.dtype)
    root, failed = torch.linalg.cholesky_ex(torch.where(seen[:, None, None], V, eye))
    seen = seen & (failed == 0)  # some are behind a camera
    root = torch.where(seen[:, None, None], root, eye)
    cross = W.new_zeros(P, 3, K, 6)
    rows = graph.point_index, slice(None), graph.frame_index
    cross[rows] = J_p.mT @ W @ J_f
    cross = torch.where(seen[:, None, None], cross.flatten(2), 0.0)
    eliminated = torch.linalg.solve_triangular(root, cross, upper=False).flatten(0, 1)
    H = torch.block_diag(*U) - eliminated.mT @ eliminated
    parameters = 6 * K + 3 * int(seen.sum()) - GAUGE
    return H / variance_factor(squared, robust.weight, parameters)


def variance_factor(squared: Tensor, weight: Tensor, parameters: int) -> Tensor:
    """What the covariance of a Huber estimate is of the inverse of its reweighted normal matrix, by the residuals.

    squared: (O,) whitened; weight: (O,) of the kernel. As in `BundleSolution.covariance`, without its correction for
    small samples. Source: Huber, "Robust statistics", 1981, section 7.6.
    """
    along = (weight == 1).to(weight.dtype)  # beyond its bend the kernel is straight
    slope = (weight + along).mean() / 2
    psi_squared = (weight.square() * squared).sum() / (2 * len(squared) - parameters)
    return psi_squared * weight.mean() / slope.square()
