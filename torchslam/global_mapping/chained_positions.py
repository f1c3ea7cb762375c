"""Positions of cameras from the baselines of pairs, whose lengths two-view geometry does not determine.

Two pairs that share an image determine the ratio of their lengths, by the depths of keypoints of the shared image that
both see. The logarithms of all lengths are the least squares of these ratios, and the positions that of the baselines.
Unlike positions from rays alone, of which parts collapse where few tracks cross, neighbors keep their scale.

Both are differences of unknowns of nodes along edges, solved by iteratively reweighted least squares (Holland and
Welsch, "Robust regression using iteratively reweighted least-squares", 1977).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry import Camera, se3_inverse
from torchslam.geometry.robust import robustify
from torchslam.global_mapping.depth_ratios import DepthRatio, PairDepths, ViewRays, depth_ratio
from torchslam.global_mapping.view_graph import Relation, ViewPair
from torchslam.optim._core.linear import Groups, build_block_structure, factorize_sparse
from torchslam.types import FrameFeatures

SYSTEMATIC_STD = 0.03
"""Standard deviation of the logarithm of a ratio beyond its own: relative poses are off by fractions of a degree."""
DIRECTION_STD = 0.05
"""Standard deviation of a baseline as a ratio of its length: 1 to 5 degrees of direction."""
WIDTHS = 20.0, 6.0, 3.0
"""Scales of the Cauchy kernel, in standard deviations, each for `STEPS` steps from the last."""
STEPS = 10
"""Steps of reweighting with each width. Tried at this value only."""
ZERO_PRIOR_WEIGHT = 1e-6
"""Relative weight that ties every node to zero: parts that nothing connects stay solvable."""


def chained_positions(
    pairs: Sequence[ViewPair],
    R_cw: Float[Tensor, "K 3 3"],
    views: Sequence[FrameFeatures],
    camera: Camera,
) -> Float[Tensor, "K 3"]:
    """Camera centers in a unit of their own, from pairs that determine a direction.

    Args:
        pairs: verified.
        R_cw: rotations of all images.
        views: features of the images.
        camera: of all images.
    """
    told = [pair for pair in pairs if pair.relation is Relation.GENERAL]
    if not told:
        return R_cw.new_zeros(len(R_cw), 3)
    lengths = pair_lengths(told, views, camera)
    ends = torch.tensor([(pair.first, pair.second) for pair in told], device=R_cw.device)
    T_12 = se3_inverse(torch.stack([pair.T_21 for pair in told]))
    baselines_w = lengths[:, None] * (R_cw[ends[:, 0]].mT @ T_12[:, :3, 3:])[..., 0]
    return solve_differences(ends, baselines_w, DIRECTION_STD * lengths, len(R_cw))


def pair_lengths(
    pairs: Sequence[ViewPair], views: Sequence[FrameFeatures], camera: Camera
) -> Float[Tensor, " P"]:
    """The lengths of the baselines of pairs, in a common unit; 1 for pairs that share no image with others."""
    rays = ViewRays.by(camera, views)
    depths = [PairDepths.of(pair.T_21, rays, pair) for pair in pairs]
    around: dict[int, list[tuple[int, int]]] = {}
    for row, pair in enumerate(pairs):
        around.setdefault(pair.first, []).append((row, 0))
        around.setdefault(pair.second, []).append((row, 1))
    edges, found = list[tuple[int, int]](), list[DepthRatio]()
    for sides in around.values():
        for (one, at_one), (other, at_other) in combinations(sides, 2):
            ratio = depth_ratio(depths[one], at_one, depths[other], at_other)
            if ratio is not None:
                edges.append((one, other))
                found.append(ratio)
    like = pairs[0].T_21
    # Inverse depths are in units of the inverse baseline: with twice the baseline, they are twice as large.
    logs = like.new_tensor([ratio.log_ratio for ratio in found]).view(-1, 1)
    stds = like.new_tensor([math.hypot(ratio.std, SYSTEMATIC_STD) for ratio in found])
    index = torch.tensor(edges, dtype=torch.int64, device=like.device).view(-1, 2)
    return solve_differences(index, logs, stds, len(pairs))[:, 0].exp()


def solve_differences(
    edges: Int[Tensor, "E 2"],
    differences: Float[Tensor, "E D"],
    stds: Float[Tensor, " E"],
    nodes: int,
) -> Float[Tensor, "{nodes} D"]:
    """The unknowns x of nodes with x[j] - x[i] = difference along edges (i, j), by robust least squares.

    Args:
        edges: nodes (i, j).
        differences: of D numbers each.
        stds: standard deviation of each.
        nodes: number of nodes.
    """
    if len(edges) == 0:
        return differences.new_zeros(nodes, differences.shape[1])
    keys, pair = torch.unique(edges.amin(1) * nodes + edges.amax(1), return_inverse=True)
    structure = build_block_structure(nodes, 1, torch.stack((keys // nodes, keys % nodes), dim=-1))
    by_pair, by_node = Groups.of(pair, len(keys)), Groups.of(edges.mT.flatten(), nodes)
    information, x = stds**-2, differences.new_zeros(nodes, differences.shape[1])
    for width in (math.inf, *(width for width in WIDTHS for _ in range(STEPS))):
        residuals = differences - (x[edges[:, 1]] - x[edges[:, 0]])
        weights = information
        if width < math.inf:
            squared = information * residuals.square().sum(-1)
            weights = information * robustify(squared, "cauchy", squared.new_tensor(width)).weight
        diagonal = by_node.sum(weights.repeat(2)[None])[0]
        diagonal = diagonal + ZERO_PRIOR_WEIGHT * diagonal.max()
        across = -by_pair.sum(weights[None])[..., None, None]
        factor = factorize_sparse(structure, diagonal[None, :, None, None], across)
        pull = weights[:, None] * residuals
        right = by_node.sum(torch.cat((-pull, pull))[None])[0]
        x = x + torch.cat([factor.solve(column[None, :, None])[0] for column in right.unbind(-1)], dim=-1)
    return x
