"""Baselines of image pairs: ratios of scales of pairs that share an image, lengths, and the positions of cameras.

A relative pose determines the depths of the matches of a pair in units of its baseline. Two pairs that share an image
determine the ratio of their lengths, by the depths of keypoints of that image that both see. The logarithms of all
lengths are the least squares of these ratios, and the positions that of the baselines. Unlike positions from rays
alone, of which parts collapse where few tracks cross, neighbors keep their scale.

Both are differences of unknowns of nodes along edges, solved by iteratively reweighted least squares (Holland and
Welsch, "Robust regression using iteratively reweighted least-squares", 1977).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchslam.geometry import Camera, rigid, se3_inverse
from torchslam.geometry.robust import median_with_error, robustify
from torchslam.global_mapping.view_graph import Relation, ViewPair
from torchslam.optim._core.linear import Groups, build_block_structure, factorize_sparse
from torchslam.types import FrameFeatures

MIN_PARALLAX_SIGMAS = 5.0
"""Parallax of a keypoint that takes part in a ratio, in units of its noise: below, inverse depths are biased."""
SIGMA_PX = 0.7
"""Noise of a parallax: that of a keypoint in either image."""
MIN_POINTS = 12
"""Least number of keypoints for a ratio of depths."""
SYSTEMATIC_STD = 0.03
"""Standard deviation of the logarithm of a ratio beyond its own: relative poses are off by fractions of a degree."""
DIRECTION_STD = 0.05
"""Standard deviation of a baseline as a ratio of its length: 1 to 5 degrees of direction."""
WIDTHS = 20.0, 6.0, 3.0
"""Scales of the Cauchy kernel, in standard deviations, each for `STEPS` steps from the last."""
STEPS = 10
"""Steps of reweighting with each width. Tried at this value only."""
DIRECTION_STEPS = 6
"""Steps of reweighting for the direction of a plane. Tried at this value only."""
ZERO_PRIOR_WEIGHT = 1e-6
"""Relative weight that ties every node to zero: parts that nothing connects stay solvable."""

Array = NDArray[np.float64]


class ViewRays:
    """Unit directions of the keypoints of images, computed once: an image is in many pairs. `focal` in pixels."""

    def __init__(self, camera: Camera, views: Sequence[FrameFeatures]) -> None:
        self.camera, self.focal, self._views = camera, float(camera.focal), views
        self._rays: dict[int, Float[Tensor, "_ 3"]] = {}

    def __getitem__(self, row: int) -> Float[Tensor, "_ 3"]:
        """The directions of all keypoints of an image."""
        if row not in self._rays:
            self._rays[row] = self.camera.unproject(self._views[row].keypoints)
        return self._rays[row]

    def of(self, pair: ViewPair) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
        """The directions of the matches of a pair, in either camera."""
        return self[pair.first][pair.keypoints_1], self[pair.second][pair.keypoints_2]


@dataclass(frozen=True)
class PairDepths:
    """Inverse depths of a pair in either image, per keypoint, NaN for those without a match, and their noise."""

    inverse: tuple[Array, Array]
    sigma: tuple[Array, Array]

    @classmethod
    def of(cls, T_21: Float[Tensor, "4 4"], rays: ViewRays, pair: ViewPair) -> PairDepths:
        """The depths by a relative pose, in its unit."""
        x_1, x_2 = rays.of(pair)
        sigma = SIGMA_PX / rays.focal
        tables = []
        for T, own, other, keypoints, count in (
            (T_21, x_1, x_2, pair.keypoints_1, len(rays[pair.first])),
            (se3_inverse(T_21), x_2, x_1, pair.keypoints_2, len(rays[pair.second])),
        ):
            # other x (R own + inverse t) = 0, by least squares.
            along = torch.linalg.cross(other, own @ T[:3, :3].mT)
            across = torch.linalg.cross(other, T[:3, 3].expand_as(other))
            reach = across.norm(dim=-1)
            table = torch.full((2, count), torch.nan, dtype=own.dtype, device=own.device)
            table[0, keypoints] = -(along * across).sum(-1) / reach.square().clamp(min=1e-30)
            table[1, keypoints] = sigma / reach.clamp(min=1e-15)
            tables.append(table.cpu().numpy())
        return cls((tables[0][0], tables[1][0]), (tables[0][1], tables[1][1]))


class DepthRatio(NamedTuple):
    """Logarithm of the median ratio of the inverse depths of one pair to those of another, and its standard error."""

    log_ratio: float
    std: float


def depth_ratio(one: PairDepths, at_one: int, other: PairDepths, at_other: int) -> DepthRatio | None:
    """Compare the inverse depths of the keypoints of a shared image by two pairs; None if too few can be compared.

    `at_one` and `at_other`: which image of either pair is shared, 0 or 1. Depths of the other are divided by the first.
    """
    a, b = one.inverse[at_one], other.inverse[at_other]
    # Comparisons with NaN are false: a keypoint that one pair does not match takes no part.
    good = (a > MIN_PARALLAX_SIGMAS * one.sigma[at_one]) & (b > MIN_PARALLAX_SIGMAS * other.sigma[at_other])
    if np.count_nonzero(good) < MIN_POINTS:
        return None
    center, _, error = median_with_error(np.log(b[good] / a[good]))
    return DepthRatio(center, error)


def chained_positions(
    pairs: Sequence[ViewPair],
    R_cw: Float[Tensor, "K 3 3"],
    views: Sequence[FrameFeatures],
    camera: Camera,
) -> Float[Tensor, "K 3"]:
    """Camera centers in a unit of their own, from pairs that determine a direction.

    By its own matches a plane determines one of two directions. Without these pairs, single images of office_loop at
    a door, which have no others, stay at the origin; by the rotations of all images there is one direction.

    Args:
        pairs: verified.
        R_cw: rotations of all images.
        views: features of the images.
        camera: of all images.
    """
    rays = ViewRays(camera, views)
    told = [
        pair if pair.relation is Relation.GENERAL else _with_direction(pair, R_cw, rays)
        for pair in pairs
        if pair.relation is not Relation.ROTATION
    ]
    if not told:
        return R_cw.new_zeros(len(R_cw), 3)
    lengths = pair_lengths(told, rays)
    ends = torch.tensor([(pair.first, pair.second) for pair in told], device=R_cw.device)
    T_12 = se3_inverse(torch.stack([pair.T_21 for pair in told]))
    baselines_w = lengths[:, None] * (R_cw[ends[:, 0]].mT @ T_12[:, :3, 3:])[..., 0]
    return solve_differences(ends, baselines_w, DIRECTION_STD * lengths, len(R_cw))


def _with_direction(pair: ViewPair, R_cw: Float[Tensor, "K 3 3"], rays: ViewRays) -> ViewPair:
    """A pair with the rotation that all images give it, and the direction in which its matches then agree.

    The direction is the least squares of the distances from epipolar planes, reweighted by Cauchy's kernel.
    """
    R_21 = R_cw[pair.second] @ R_cw[pair.first].mT
    x_1, x_2 = rays.of(pair)
    turned = x_1 @ R_21.mT
    normals = torch.linalg.cross(turned, x_2)
    weights = torch.ones_like(normals[:, 0])
    for _ in range(DIRECTION_STEPS):
        t_21 = torch.linalg.eigh((normals * weights[:, None]).mT @ normals).eigenvectors[:, 0]
        squared = ((normals @ t_21) * (rays.focal / SIGMA_PX)).square()
        weights = robustify(squared, "cauchy", squared.new_ones(())).weight
    # Of both signs, that with more of the points in front of the cameras.
    along = torch.linalg.cross(x_2, turned) * torch.linalg.cross(x_2, t_21.expand_as(x_2))
    t_21 = t_21.where(along.sum(-1) @ weights <= 0, -t_21)
    return replace(pair, T_21=rigid(R_21, t_21))


def pair_lengths(pairs: Sequence[ViewPair], rays: ViewRays) -> Float[Tensor, " P"]:
    """The lengths of the baselines of pairs, in a common unit; 1 for pairs that share no image with others."""
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
