"""How well a map ties the scale on both sides of each moment between two of its keyframes.

The keyframes after a moment, and what they see, may be scaled, turned and moved against those before it. What resists
are the points that both sides see. With the points eliminated, the information of the seven numbers of that similarity
is a sum over these points; the error of the scale follows from it, translation and rotation eliminated as well. A
camera that stands still sees hundreds of points on both sides and is tied well, a door that two frames show is not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry.lie import skew, transform
from torchslam.geometry.precision import full_precision
from torchslam.optim._core.levenberg_marquardt import GRAPH_OPTIONS, SolverOptions
from torchslam.optim._core.residuals import ReprojectionData, linearize
from torchslam.optim.bundle._problem import BundleProblem
from torchslam.optim.observation_graph import RunGraph, keyframe_problem


@dataclass(frozen=True)
class ScaleLinks:
    """The scale across the moments between the keyframes of a map.

    Attributes:
        frames: frame of each keyframe, ascending.
        std: standard deviation of the logarithm of the scale after each keyframe but the last to that before;
            infinite where no point connects the two sides.
    """

    frames: tuple[int, ...]
    std: tuple[float, ...]

    def weakest(self, before: int, after: int) -> float:
        """The largest standard deviation at a moment between two frames; 0 where there is none."""
        moments = zip(self.frames, self.frames[1:], self.std, strict=False)
        return max((std for first, last, std in moments if first < after and last > before), default=0.0)


def scale_links(graph: RunGraph, session: int = 0) -> ScaleLinks:
    """The scale links of the submap with most frames of a session, over its keyframes of that session."""
    submap = int(torch.bincount(graph.submap[graph.sessions == session]).argmax())
    keyframes, *_, problem = keyframe_problem(graph.global_shutter(), submap)
    order = torch.argsort(graph.frame_ids[keyframes] + (graph.sessions[keyframes] << 32))
    std = scale_stds(problem, torch.argsort(order))
    own = graph.sessions[keyframes][order] == session
    inside = (own[:-1] & own[1:]).tolist()
    frames = graph.frame_ids[keyframes][order][own].tolist()
    return ScaleLinks(tuple(frames), tuple(s for s, is_in in zip(std.tolist(), inside, strict=True) if is_in))


@full_precision
@torch.no_grad()
def scale_stds(
    problem: BundleProblem, rank: Int[Tensor, " K"], options: SolverOptions = GRAPH_OPTIONS
) -> Float[Tensor, " K-1"]:
    """Standard deviation of the logarithm of the scale across each moment between two frames. Detached.

    Both sides are rigid, so it is a lower bound where frames near the moment are loose themselves. A side of a single
    frame has no scale: its moment has zero.

    problem: at its minimum with the kernel and scale of options; rank: place of each frame in the order of time
    """
    T_cw, frame, point = problem.T_cw, problem.frame_index, problem.point_index
    frames, points_w = len(T_cw), problem.points_w
    information = _point_information(problem, options)
    total = information.new_zeros(len(points_w), 3, 3).index_add_(0, point, information)
    before = torch.zeros_like(total)
    when = rank[frame]
    first = point.new_full((len(points_w),), frames).scatter_reduce(0, point, when, "amin")
    last = first.new_full((len(points_w),), -1).scatter_reduce(0, point, when, "amax")
    order, ends = torch.argsort(when, stable=True), torch.bincount(when, minlength=frames).cumsum(0).tolist()
    centers_w = -(T_cw[:, :3, :3].mT @ T_cw[:, :3, 3:])[torch.argsort(rank), :, 0]
    found = points_w.new_zeros(frames - 1)
    # Else the kernel leaves its observations no weight.
    is_known = total.diagonal(dim1=-2, dim2=-1).sum(-1) > 0
    begin = 0
    for moment in range(frames - 1):
        rows, begin = order[begin : ends[moment]], ends[moment]
        before.index_add_(0, point[rows], information[rows])
        if 0 < moment < frames - 2:
            across = ((first <= moment) & (last > moment) & is_known).nonzero()[:, 0]
            found[moment] = _scale_std(before[across], total[across], points_w[across] - centers_w[moment])
    return found


def _point_information(problem: BundleProblem, options: SolverOptions) -> Float[Tensor, "O 3 3"]:
    """Information of each observation about its point with its frame fixed, weighted by the kernel."""
    T_cw = problem.T_cw[problem.frame_index]
    points_c = transform(T_cw, problem.points_w[problem.point_index][:, None])[:, 0]
    assert problem.weights is not None
    scale = points_c.new_tensor(options.scale)
    lin = linearize(
        ReprojectionData(problem.pixels, problem.weights, problem.camera, options.kernel, scale), points_c
    )
    J = lin.J @ T_cw[:, :3, :3]
    return J.mT @ (lin.weight[:, None, None] * J)


def _scale_std(
    before: Float[Tensor, "N 3 3"], total: Float[Tensor, "N 3 3"], offsets: Float[Tensor, "N 3"]
) -> float:
    """The error of the scale by points that both sides see; offsets: of the points from the center of the scaling."""
    if len(offsets) < 3:
        return math.inf
    unit = offsets.norm(dim=-1).median().clamp_min(1e-12)
    offsets = offsets / unit
    eye = torch.eye(3, dtype=offsets.dtype, device=offsets.device)
    # A point on the ray of all its views has a singular information.
    ridge = 1e-9 * total.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * eye
    # The two sides of a point are two springs in series.
    series = before @ torch.linalg.solve(total + ridge, total - before)
    moves = torch.cat((eye.expand(len(offsets), 3, 3), -skew(offsets), offsets[..., None]), dim=-1)
    information = unit**2 * (moves.mT @ series @ moves).sum(0)
    rigid, mixed = information[:6, :6], information[:6, 6]
    factor, failed = torch.linalg.cholesky_ex(rigid)
    if bool(failed):
        return math.inf
    left = float(information[6, 6] - mixed @ torch.cholesky_solve(mixed[:, None], factor)[:, 0])
    return left**-0.5 if left > 0 else math.inf
