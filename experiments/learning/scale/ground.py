"""The height of a camera over the ground in front of it, by a plane sweep, and the scale of motion from it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.dense.cost_volume import correlation
from torchslam.geometry import Camera, rigid, se3_inverse, so3_log, transform
from torchslam.optim import POSE_GRAPH_OPTIONS, PoseGraph, PoseGraphSolution, solve_pose_graph

ROWS, COLUMNS = 60, 40
"""Samples of the patch of ground: rows at equal steps of 1 / distance, as pixels are."""
FARTHEST = 2.0
"""Far edge of the patch over its near edge, which is where the ground enters the image."""
HALF_WIDTH = 0.6
"""Half of the width of the patch in heights: 1 m for a car's camera at 1.65 m, within its lane."""
RADIUS = 8
"""Of the correlated windows, in samples."""
NEIGHBORS = (-2, -1, 1, 2)
"""Keyframes that a keyframe is compared with."""
SPAN = 4
"""Keyframes before and after that the direction of travel is measured over."""
COARSE = torch.arange(-4.0, 1.0, 0.04, dtype=torch.float64)
"""Log heights in map units tried for the whole recording; the median depth of the first map is 1."""
FINE = torch.arange(-0.5, 0.505, 0.01, dtype=torch.float64)
"""Log heights of a keyframe relative to that of the recording."""
TOGETHER = 2
"""Keyframes before and after whose scores are averaged."""
APART = 10
"""Steps of `FINE` between the best height and the second best one."""
KERNEL = 1.5
"""Scale of the robust kernel in standard deviations: a wrong height pulls no harder."""
FEATURES = ("log spread", "best score", "lead over the second best", "curvature", "texture", "turn")
MIN_SPREAD = 0.01
"""A step of `FINE`."""


@dataclass(frozen=True)
class Heights:
    """Measured heights of K keyframes over the ground.

    Attributes:
        log_height: of the best score, relative to the recording.
        measured: whether the best score is within the range that was tried.
        features: what the scores and the motion look like: see `FEATURES`.
    """

    log_height: Float[Tensor, " K"]
    measured: Bool[Tensor, " K"]
    features: Float[Tensor, "K D"]


def ground_normals(T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 3"]:
    """The downward normal of the ground in each camera, if it moves along the ground and is held without roll."""
    rows = torch.arange(len(T_cw))
    centers_w = se3_inverse(T_cw)[:, :3, 3]
    ahead = centers_w[(rows + SPAN).clamp(max=len(T_cw) - 1)] - centers_w[(rows - SPAN).clamp(min=0)]
    travel = F.normalize((T_cw[:, :3, :3] @ ahead[..., None])[..., 0], dim=-1)
    down = T_cw.new_tensor((0.0, 1.0, 0.0))
    return F.normalize(down - travel[:, 1:2] * travel, dim=-1)


def ground_patch(camera: Camera, normal: Float[Tensor, " 3"]) -> Float[Tensor, "H W 3"]:
    """Points on the ground in front of the camera, in units of its height."""
    forward = F.normalize(normal.new_tensor((0.0, 0.0, 1.0)) - normal[2] * normal, dim=-1)
    right = torch.linalg.cross(normal, forward)
    # Where the ray of the lowest pixel in the middle meets the ground.
    ray = camera.unproject(torch.stack((camera.cx, camera.cy.new_tensor(camera.height - 1.0)))[None])[0].to(
        normal
    )
    near = 1.02 * float(ray @ forward) / max(float(ray @ normal), 1e-3)
    z = 1 / torch.linspace(1 / (FARTHEST * near), 1 / near, ROWS, dtype=normal.dtype)
    x = torch.linspace(-HALF_WIDTH, HALF_WIDTH, COLUMNS, dtype=normal.dtype)
    return normal + z[:, None, None] * forward + x[:, None] * right


def sample(
    image: Float[Tensor, "1 1 h w"], camera: Camera, points_c: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Gray values where points are seen, and whether they are."""
    pixels, in_front = camera.project(points_c.reshape(-1, 3))
    grid = (pixels + 0.5) / pixels.new_tensor(camera.size) * 2 - 1
    values = F.grid_sample(image, grid[None, None].to(image), padding_mode="border", align_corners=False)
    seen = in_front & camera.in_image(pixels)
    return values.reshape(points_c.shape[:-1]), seen.reshape(points_c.shape[:-1])


def sweep(
    images: list[Tensor], camera: Camera, T_cw: Float[Tensor, "K 4 4"], log_heights: Float[Tensor, " S"]
) -> tuple[Float[Tensor, "K S"], Float[Tensor, " K"]]:
    """How well the ground in front of each keyframe agrees with its neighbors at each height.

    Returns:
        Mean over the neighbors of the median correlation of the windows, -1 to 1, 0 where nothing is seen; standard
        deviation of the gray values of the patch.
    """
    scores, texture = T_cw.new_zeros(len(T_cw), len(log_heights)), T_cw.new_zeros(len(T_cw))
    for i, normal in enumerate(ground_normals(T_cw)):
        patch = ground_patch(camera, normal)
        reference, seen = sample(images[i], camera, patch)
        texture[i] = reference.std()
        neighbors = [i + step for step in NEIGHBORS if 0 <= i + step < len(T_cw)]
        for j in neighbors:
            T_ji = T_cw[j] @ se3_inverse(T_cw[i])
            # At height h a point h X is seen where X is after a motion by t / h.
            shrunk = T_ji[:3, 3] * torch.exp(-log_heights)[:, None]
            T = rigid(T_ji[:3, :3].expand(len(shrunk), 3, 3), shrunk)
            values, also = sample(
                images[j], camera, transform(T, patch.reshape(-1, 3)).reshape(-1, *patch.shape)
            )
            agreement = correlation(reference.expand_as(values), values, RADIUS) * (seen & also)
            found = agreement[:, RADIUS::RADIUS, RADIUS::RADIUS].flatten(1).quantile(0.5, dim=-1)
            scores[i] += found / len(neighbors)
    return scores, texture


def windows(values: Float[Tensor, "K *D"], radius: int) -> Float[Tensor, "K *D W"]:
    """The values of each keyframe and of those around it; at the ends the last ones again."""
    rows = torch.arange(len(values))[:, None] + torch.arange(-radius, radius + 1)
    return values[rows.clamp(0, len(values) - 1)].movedim(1, -1)


def measure_heights(images: list[Tensor], camera: Camera, T_cw: Float[Tensor, "K 4 4"]) -> Heights:
    """Find the height of a recording, then that of each keyframe near it."""
    whole = sweep(images, camera, T_cw, COARSE)[0].mean(0)
    alone, texture = sweep(images, camera, T_cw, COARSE[whole.argmax()] + FINE)
    scores = windows(alone, TOGETHER).mean(-1)
    best, row = scores.max(-1)
    last = len(FINE) - 1
    apart = (torch.arange(last + 1) - row[:, None]).abs() >= APART
    second = torch.where(apart, scores, -1.0).max(-1).values
    beside = sum(scores.gather(-1, (row + step).clamp(0, last)[:, None])[:, 0] for step in (-3, 3)) / 2
    others = windows(FINE[alone.argmax(-1)], 2 * TOGETHER)
    spread = 1.48 * (others - FINE[row][:, None]).abs().median(-1).values
    R = windows(T_cw[:, :3, :3], 1)
    turn = so3_log(R[..., 2] @ R[..., 0].mT).norm(dim=-1)
    log_spread = spread.clamp(min=MIN_SPREAD).log()
    features = torch.stack((log_spread, best, best - second, best - beside, texture, turn), -1)
    return Heights(FINE[row], (row > 0) & (row < last), features)


def scaled_by_heights(
    T_cw: Float[Tensor, "*batch K 4 4"],
    log_height: Float[Tensor, "*batch K"],
    information: Float[Tensor, "*batch K"],
    edge_std: Float[Tensor, ""] | float,
) -> PoseGraphSolution:
    """The motions of keyframes, and their log heights as factors, in one pose graph over similarities.

    Node 0 is the ground, fixed; node k + 1 is keyframe k, whose log scale is its log height up to a constant.

    Args:
        T_cw: keyframes in order of time, or a batch of such parts.
        log_height: measured.
        information: inverse variances of the log heights; 0: not measured.
        edge_std: standard deviation of the change of log scale from one keyframe to the next.
    """
    count = T_cw.shape[-3]
    rows = torch.arange(1, count + 1)
    edges = torch.cat(
        (torch.stack((torch.zeros_like(rows), rows), -1), torch.stack((rows[:-1], rows[1:]), -1))
    )
    motions = T_cw[..., 1:, :, :] @ se3_inverse(T_cw[..., :-1, :, :])
    # Around the mean height, so that what is found has the mean scale of what was given.
    share = information / information.sum(-1, keepdim=True).clamp(min=1e-12)
    change = log_height - (share * log_height).sum(-1, keepdim=True)
    heights = rigid(T_cw[..., :3, :3] * change.exp()[..., None, None], T_cw[..., :3, 3])
    diagonal = T_cw.new_zeros(*T_cw.shape[:-3], 2 * count - 1, 7)
    diagonal[..., 0, :6] = 1.0  # the pose of the first keyframe stays
    diagonal[..., :count, 6] = information
    diagonal[..., count:, :6] = 1.0
    diagonal[..., count:, 6] = 1 / torch.as_tensor(edge_std) ** 2
    ground = torch.eye(4).to(T_cw).expand(*T_cw.shape[:-3], 1, 4, 4)
    graph = PoseGraph(
        torch.cat((ground, T_cw), -3), edges, torch.cat((heights, motions), -3), torch.diag_embed(diagonal)
    )
    return solve_pose_graph(graph, options=POSE_GRAPH_OPTIONS.replace(kernel="huber", scale=KERNEL))
