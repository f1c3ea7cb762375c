"""The keyframes of a run's graph as a bundle adjustment in which the camera moves, too."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchslam.geometry import Camera
from torchslam.optim import BundleProblem, BundleSolution, bundle_adjust
from torchslam.optim.run_graph import ObservationGraph

KERNEL_SCALE = 2.45  # as in `solve`: ends the quadratic part at 95 % of a Gaussian
TOLERANCE = 1e-6
ITERATIONS = 400  # where all depths have to move with a focal length that is far off, 200 are needed
MIN_FRAMES = 24  # frames that a camera is refined on, if there are
# What is looked at of a camera, in this order: the logarithm of the focal length, k1, k2, and the principal point.
FOCAL, K1, K2, CX, CY = range(5)


def problem_of(graph: ObservationGraph) -> BundleProblem:
    """The frames of `frames_of` and the points that they see."""
    frames = frames_of(graph)
    slots = torch.full_like(graph.world, -1)
    slots[frames] = torch.arange(len(frames), device=slots.device)
    rows = (slots[graph.frame_index] >= 0).nonzero().squeeze(-1)
    points, point_index = torch.unique(graph.point_index[rows], return_inverse=True)
    return BundleProblem(
        graph.T_cw[frames],
        graph.points_w[points],
        slots[graph.frame_index[rows]],
        point_index,
        graph.pixels[rows],
        graph.camera,
        graph.weights[rows],
    )


def subproblem(problem: BundleProblem, start: int, stop: int) -> BundleProblem:
    """The frames from `start` to before `stop` and the points that they see."""
    rows = ((problem.frame_index >= start) & (problem.frame_index < stop)).nonzero().squeeze(-1)
    points, point_index = torch.unique(problem.point_index[rows], return_inverse=True)
    assert problem.weights is not None
    return replace(
        problem,
        T_cw=problem.T_cw[start:stop],
        points_w=problem.points_w[points],
        frame_index=problem.frame_index[rows] - start,
        point_index=point_index,
        pixels=problem.pixels[rows],
        weights=problem.weights[rows],
    )


def frames_of(graph: ObservationGraph) -> Tensor:
    """(n,) the keyframes of the graph's largest world, by time; where they are few, frames in between with them."""
    world = torch.bincount(graph.world).argmax()
    frames = (graph.world == world).nonzero().squeeze(-1)
    frames = frames[torch.argsort(graph.timestamps[frames], stable=True)]
    keyframes = graph.is_keyframe[frames].nonzero().squeeze(-1)
    missing = MIN_FRAMES - len(keyframes)
    if missing > 0:
        others = (~graph.is_keyframe[frames]).nonzero().squeeze(-1)
        every = max(1, -(-len(others) // missing))
        keyframes = torch.cat([keyframes, others[every // 2 :: every]]).sort().values
    return frames[keyframes]


def directions(camera: Camera, which: list[int]) -> Tensor:
    """(K, n) how the camera's parameters change with the log of the focal length, k1, k2, and the centre in widths."""
    columns = camera.params.new_zeros(len(camera.params), 5)
    columns[:2, FOCAL] = camera.params[:2]
    columns[[2, 3], [CX, CY]] = float(camera.width)
    if camera.model != "pinhole":
        columns[[4, 5], [K1, K2]] = 1.0
    return columns[:, which]


def adjust_with_camera(
    problem: BundleProblem, which: list[int], iterations: int = ITERATIONS
) -> BundleSolution:
    """The least robust cost over poses, points and those parameters of the camera."""
    return bundle_adjust(
        problem,
        "huber",
        KERNEL_SCALE,
        directions(problem.camera, which),
        "detached",
        iterations,
        TOLERANCE,
    )


def with_radial_terms(camera: Camera) -> Camera:
    """The same camera in a model that can bend the image."""
    if camera.model != "pinhole":
        return camera
    return Camera("radial_tangential", torch.cat([camera.params, camera.params.new_zeros(5)]), camera.size)


def simplify_model(camera: Camera) -> Camera:
    """The same camera, as a pinhole where it does not bend the image."""
    if camera.model != "radial_tangential" or bool(camera.params[4:].any()):
        return camera
    return Camera("pinhole", camera.params[:4], camera.size)
