"""Find a zoom in the graph of a map: focal lengths that change along the recording.

Nodes along the keyframes have focal lengths of their own, linear in between. The slopes of the cost in these, frames,
points and the common camera eliminated, give a Gauss-Newton step and say how much it predicts: points are divided into
halves, and the step of one half is judged by the other one in the same frames, since no other frame tells of a focal
length. Where it predicts better, keypoints are corrected by the step, the keyframes are adjusted, and steps follow
until they settle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import (
    FOCAL,
    K1,
    K2,
    CameraMeasurement,
    intrinsics_directions,
    with_radial_terms,
)
from torchslam.geometry.precision import full_precision
from torchslam.geometry.zoom import Zoom
from torchslam.optim._core.levenberg_marquardt import SolverOptions
from torchslam.optim._core.linear import smallest_pivot
from torchslam.optim._core.tangent import CameraPrior
from torchslam.optim.bundle._problem import BundleProblem
from torchslam.optim.bundle._scores import focal_scores
from torchslam.optim.bundle._solve import solve_bundle
from torchslam.optim.model_choice import LEAST_GAIN, STRETCHES, Gain
from torchslam.optim.observation_graph import RunGraph, camera_prior, keyframe_problem

NODES, FINE_NODES = 24, 120
"""Most focal lengths along a recording, in the first step, and once a zoom is found. With 24, a test of 152 keyframes
takes 1.6 CPU s of the 108 of a run. Tried at these values only."""
MIN_KEYFRAMES = 4
"""Keyframes from which on a zoom is sought: with three, scale and structure follow any."""
STD = 0.2
"""Standard deviation of the logarithm of a focal length before the images say more. Tried at this value only."""
LEAST_SPREAD, LEAST_EXPLAINED = 0.0035, 0.02
"""Standard deviation of the logarithms of focal lengths along a recording, and gain for each observation, from which
on a zoom is undone: errors of the lens are shared by all points, and a held-out half of them confirms those as well. Of
111 windows of 12, 24 and 40 keyframes and whole recordings without a known change, one has both (.0038, .035); garden,
whose focal length changes by 1 %, has up to .005 and .05. Rendered changes of 2 % have .0061 and .06 or more."""
WALKS = 3e-4, 1e-3, 3e-3, 1e-2, math.inf
"""Scales of the step of the logarithm from one focal length to the next, of which the smallest is used that predicts
about as well as the best: zooms are smooth or sudden, and an independent error in each keyframe bends the path."""
CONVEX_STEPS, ROBUST_STEPS = 8, 4
"""Of iteratively reweighted least squares for the prior on these steps. Tried at these values only."""
ROUNDS, SETTLED = 10, 5e-4
"""Most steps, and the largest change of a logarithm that ends them. A zoom by 1.4 of which the run knew nothing takes
four to six. Tried at these values only."""
JUMP, SUDDEN = 0.006, 0.35
"""Change of a logarithm from one keyframe to the next from which on focal lengths of the frames between are sought, and
the share of it by which one of them must depart from the straight line: else the zoom is gradual, and they have that of
the line. Frames alone have errors of .003. Tried at these values only."""
CHUNK = 64
"""Frames between keyframes that are solved together, which bounds the memory."""


@dataclass(frozen=True)
class ZoomEstimate:
    """A zoom by the graph of a map.

    Attributes:
        zoom: ratios of the keyframes.
        camera: of the images whose zoom is undone.
        gain: how much better half of the points is predicted by the zoom that the other half finds, in both directions,
            than by one focal length.
        observations: number of those.
        spread: standard deviation of the logarithms of the ratios after the first step.
        is_known: whether there is a zoom, of which a part was undone: what is left is believed with less gain.
    """

    zoom: Zoom
    camera: Camera
    gain: Gain
    observations: int
    spread: float
    is_known: bool = False

    @property
    def is_found(self) -> bool:
        """Whether the zoom is to be undone."""
        if self.is_known and self.gain.total > 0:
            return True
        is_explained = self.gain.is_worth() and self.gain.total > LEAST_EXPLAINED * self.observations
        return is_explained and self.spread > LEAST_SPREAD


@full_precision
@torch.no_grad()
def find_zoom(
    graph: RunGraph, given: CameraMeasurement, options: SolverOptions, is_known: bool = False
) -> ZoomEstimate | None:
    """Estimate the zoom of the submap with most keyframes of a graph that is at its minimum.

    The ratio of the first keyframe is 1. A zoom that is not found has the mean 1, and is that of a single step.

    Args:
        graph: of one session.
        given: the camera with its error.
        options: of the adjustment of its keyframes.
        is_known: as of the estimate.

    Returns:
        The estimate; None for too few keyframes, or where the observations do not determine it.
    """
    graph = graph.global_shutter()
    keyframes, *_, problem = keyframe_problem(graph, graph.main_submap)
    count = len(keyframes)
    if count < MIN_KEYFRAMES:
        return None
    order = torch.argsort(graph.frame_ids[keyframes])
    rank = torch.argsort(order)
    first = replace(problem, camera=with_radial_terms(problem.camera), camera_prior=camera_prior(given))
    nodes = first.pixels.new_zeros(min(count, NODES))
    shares = _shares(rank / (count - 1), nodes)
    evidence = _Evidence.of(first, shares, rank, options)
    if evidence is None:
        return None
    walk = evidence.best_walk(nodes) if is_known else math.inf
    gain, nodes = evidence.gain(nodes, walk), evidence.moved(nodes, walk)
    logs = shares @ (nodes - nodes.mean())
    spread = float(logs.std())
    zoom = _zoom(graph, keyframes, logs)
    found = ZoomEstimate(zoom, first.camera, gain, len(first.pixels), spread, is_known)
    if not found.is_found:
        return found
    fine = first.pixels.new_zeros(min(count, FINE_NODES))
    nodes = _shares(torch.linspace(0, 1, len(fine), dtype=fine.dtype, device=fine.device), nodes) @ nodes
    shares, problem = _shares(rank / (count - 1), fine), first
    for _ in range(ROUNDS):
        logs = shares @ (nodes - nodes.mean())
        problem = _solved(first, problem, logs, given, options)
        evidence = _Evidence.of(problem, shares, rank, options)
        if evidence is None:
            break
        before, walk = nodes, evidence.best_walk(nodes)
        nodes = evidence.moved(nodes, walk)
        if float((nodes - before - (nodes - before).mean()).abs().max()) < SETTLED:
            break
    # So far the mean is 1; the camera is that of the first keyframe.
    focal = problem.camera.params[:2] * logs[order[0]].exp()
    camera = problem.camera.with_params(torch.cat((focal, problem.camera.params[2:])))
    return replace(found, zoom=_zoom(graph, keyframes, logs - logs[order[0]]), camera=camera)


def _shares(places: Float[Tensor, " K"], nodes: Float[Tensor, " F"]) -> Float[Tensor, "K F"]:
    """The share of each node in the focal length at places from 0, the first node, to 1, the last."""
    at = torch.arange(len(nodes), dtype=nodes.dtype, device=nodes.device)
    return (1 - (places.to(nodes)[:, None] * (len(nodes) - 1) - at).abs()).clamp_min(0)


def _zoom(graph: RunGraph, keyframes: Int[Tensor, " K"], logs: Float[Tensor, " K"]) -> Zoom:
    frames, order = graph.frame_ids[keyframes].sort()
    return Zoom(frames.cpu(), logs[order].exp().cpu())


def _solved(
    first: BundleProblem,
    now: BundleProblem,
    logs: Float[Tensor, " K"],
    given: CameraMeasurement,
    options: SolverOptions,
) -> BundleProblem:
    """The keyframes and points adjusted to the pixels of the first problem without this zoom."""
    ratios = logs.exp()[first.frame_index]
    center = first.camera.params[2:4]
    pixels = center + (first.pixels - center) / ratios[:, None]
    problem = replace(now, pixels=pixels)
    found = solve_bundle(problem, free_camera=given.directions, check=False, options=options)
    return replace(problem, T_cw=found.T_cw, points_w=found.points_w, camera=found.camera)


@dataclass(frozen=True)
class _Evidence:
    """The cost of halves of the points in stretches of a recording as functions of the logarithms of focal lengths.

    Attributes:
        scores: of half and stretch: the slope downhill.
        information: of the same.
        variance: of an observation, in units of the stated one.
    """

    scores: Float[Tensor, "2 S F"]
    information: Float[Tensor, "2 S F F"]
    variance: float

    @classmethod
    def of(
        cls,
        problem: BundleProblem,
        shares: Float[Tensor, "K F"],
        rank: Int[Tensor, " K"],
        options: SolverOptions,
    ) -> _Evidence | None:
        """None where the observations do not determine frames, points and camera; rank: of keyframes in time."""
        directions = intrinsics_directions(problem.camera, [FOCAL, K1, K2])
        found = focal_scores(problem, shares, directions, options)
        if found is None:
            return None
        nodes, count = shares.shape[1], len(rank)
        stretches = min(STRETCHES, count // 2)
        # Every other point, in the order of the problem: halves that are alike in all frames.
        cell = (found.point_index % 2) * stretches + rank[found.frame_index] * stretches // count
        scores, information = [], []
        for number in range(2 * stretches):
            rows = (cell == number).nonzero()[:, 0]
            slopes = found.slopes[rows]
            scores.append(-torch.einsum("oif,oi->f", slopes, found.residuals[rows]))
            weighted = slopes * found.weight[rows, None, None]
            information.append(weighted.flatten(0, 1).mT @ slopes.flatten(0, 1))
        return cls(
            torch.stack(scores).view(2, stretches, nodes),
            torch.stack(information).view(2, stretches, nodes, nodes),
            float(found.variance),
        )

    def moved(self, nodes: Float[Tensor, " F"], walk: float) -> Float[Tensor, " F"]:
        """The focal lengths that all observations find."""
        return self._minimum(self.scores.sum((0, 1)), self.information.sum((0, 1)), nodes, walk)

    def gain(self, nodes: Float[Tensor, " F"], walk: float) -> Gain:
        """How much better each half of the points is predicted by what the other half finds than by `nodes`."""
        scores, information = self.scores.sum(1), self.information.sum(1)
        others = [self._minimum(scores[half], information[half], nodes, walk) - nodes for half in (1, 0)]
        step = torch.stack(others)[:, None]
        quadratic = (step[..., None, :] @ self.information @ step[..., None])[..., 0, 0]
        return Gain.of_stretches(((step * self.scores).sum(-1) - 0.5 * quadratic).sum(0) / self.variance)

    def best_walk(self, nodes: Float[Tensor, " F"]) -> float:
        """The smallest walk that predicts about as well as the best one."""
        gains = [self.gain(nodes, walk).total for walk in WALKS]
        return next(walk for walk, gain in zip(WALKS, gains, strict=True) if gain > max(gains) - LEAST_GAIN)

    def _minimum(
        self, scores: Float[Tensor, " F"], information: Float[Tensor, "F F"], nodes: Tensor, walk: float
    ) -> Float[Tensor, " F"]:
        """The minimum of a cost with steps of nodes that are small, but for a few.

        walk: scale of the step from one node to the next; infinite: independent ones
        """
        eye = torch.eye(len(nodes), dtype=nodes.dtype, device=nodes.device)
        # A factor on all focal lengths changes nothing: exact observations alone leave it open.
        least = smallest_pivot(nodes.dtype) * float(information.diagonal().amax())
        own = information + max(self.variance / STD**2, least) * eye
        right = scores + information @ nodes
        if math.isinf(walk):
            return torch.linalg.solve(own, right)
        difference, found = eye[1:] - eye[:-1], nodes
        for is_convex in (*[True] * CONVEX_STEPS, *[False] * ROBUST_STEPS):
            steps = found.diff().abs()
            # Of total variation, which finds the large steps, and of Cauchy's distribution, which leaves them alone.
            precision = 1 / (walk * steps.clamp_min(walk)) if is_convex else 1 / (walk**2 + steps.square())
            prior = self.variance * difference.mT @ (precision[:, None] * difference)
            found = torch.linalg.solve(own + prior, right)
        return found


@full_precision
@torch.no_grad()
def with_jumps(graph: RunGraph, zoom: Zoom, options: SolverOptions) -> Zoom:
    """The zoom with the frames between keyframes whose focal lengths differ suddenly: each has its own, by the points.

    Args:
        graph: solved without the zoom, whose frames have their pixels without it.
        zoom: of its keyframes.
        options: of the solution of the frames.

    Returns:
        The zoom of the images with the frames in between; what is left of it is in the pixels of the graph.
    """
    graph = graph.global_shutter()
    jump = zoom.ratios.log().diff().abs()
    others = (~graph.is_keyframe & (graph.submap == graph.main_submap)).nonzero()[:, 0]
    ids = graph.frame_ids[others].cpu()
    after = torch.searchsorted(zoom.frames, ids)
    is_between = (after > 0) & (after < len(zoom.frames))
    size = torch.where(is_between, jump[(after - 1).clamp(0, max(len(jump) - 1, 0))], 0.0)
    wanted = (size > JUMP).nonzero()[:, 0]
    frames, ratios = ids[wanted], zoom.at(ids[wanted])
    left = torch.ones_like(ratios)
    for rows in torch.arange(len(wanted), device="cpu").split(CHUNK) if len(wanted) else ():
        own = others[wanted[rows].to(others.device)]
        left[rows] = _focal_lengths(graph, own, size[wanted[rows]].to(graph.pixels), options).cpu()
    departure = torch.zeros_like(jump).scatter_reduce(0, after[wanted] - 1, left.log().abs(), "amax")
    is_sudden = (departure > SUDDEN * jump)[after[wanted] - 1]
    frames = torch.cat((zoom.frames, frames[is_sudden]))
    order = torch.argsort(frames)
    return Zoom(frames[order], torch.cat((zoom.ratios, (ratios * left)[is_sudden]))[order])


def _focal_lengths(
    graph: RunGraph, frames: Int[Tensor, " F"], std: Float[Tensor, " F"], options: SolverOptions
) -> Float[Tensor, " F"]:
    """Ratios of the focal lengths of frames to that of the camera, by the points; std: of the logarithms before."""
    slot = torch.full_like(graph.submap, -1)
    slot[frames] = torch.arange(len(frames), device=frames.device)
    rows = (slot[graph.frame_index] >= 0).nonzero()[:, 0]
    points, point_index = torch.unique(graph.point_index[rows], return_inverse=True)
    direction = intrinsics_directions(graph.camera, [FOCAL])
    across = torch.linalg.pinv(direction)
    params = graph.camera.params.detach().expand(len(frames), -1).clone()
    problem = BundleProblem(
        graph.T_cw[frames],
        graph.points_w[points],
        slot[graph.frame_index[rows]],
        point_index,
        graph.pixels[rows],
        Camera(graph.camera.model, params, graph.camera.size),
        graph.weights[rows],
        fixed_frames=(),
        fixed_points=torch.ones(len(points), dtype=torch.bool, device=points.device),
        camera_index=torch.arange(len(frames), device=frames.device),
        camera_prior=CameraPrior(params, (across.mT @ across) / std[:, None, None] ** 2),
    )
    found = solve_bundle(problem, free_camera=direction, check=False, options=options)
    return found.camera.params[:, 0] / params[:, 0]
