"""A long street: every keyframe sees few points with its neighbors alone, so that the scale of the map drifts."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.map.simulated import estimate_at
from tests.metric.drives import level_poses
from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.map.atlas import Submap
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.run_graph import solve_graph
from torchslam.types import FrameFeatures

CAMERA = Camera.pinhole(300.0, 300.0, 319.5, 119.5, size=(640, 240))
STEP = 2.0
"""Meters, and a second, from keyframe to keyframe; a frame is half way."""
REACH = 4
"""Keyframes that see a point."""


def street(count: int) -> Tensor:
    """Poses T_ec (2 count - 1, 4, 4) along a street that turns one way, then the other."""
    at = torch.arange(2 * count - 1, dtype=torch.float64)
    heading = 1.2 * (at * (3.0 / len(at))).sin()
    step = torch.stack((heading.cos(), heading.sin(), torch.zeros_like(at)), dim=-1) * STEP / 2
    return level_poses(step.cumsum(0) - step, heading)


def drifting_submap(
    count: int = 60, noise: float = 0.3, per_keyframe: int = 14, seed: int = 0
) -> tuple[Submap, Tensor, Tensor]:
    """The submap at the minimum of its observations, times (F,) of its frames, and true poses T_ec (F, 4, 4)."""
    generator = torch.Generator().manual_seed(seed)
    T_ec = street(count)
    T_ce = se3_inverse(T_ec)
    # The first keyframe sees as many points as the others.
    keyframes = (torch.arange(count + REACH - 1) - REACH + 1).clamp_min(0)
    ahead = torch.rand(len(keyframes), per_keyframe, 3, generator=generator, dtype=torch.float64)
    side = torch.where(ahead[..., :1] > 0.5, 1.0, -1.0) * (3 + 3 * ahead[..., :1])
    local_c = torch.cat((side, 3 * ahead[..., 1:2] - 1.5, 8 + 4 * ahead[..., 2:]), dim=-1)
    points_e = transform(T_ec[2 * keyframes], local_c)  # (count + REACH - 1, per keyframe, 3)
    submap = Submap.empty(0, CAMERA.params.double())
    ids = torch.full((len(keyframes), per_keyframe), -1)
    for row in range(len(T_ec)):
        first = row // 2
        shown = points_e[first : first + REACH].flatten(0, 1)
        pixels, valid = CAMERA.project(transform(T_ce[row], shown))
        valid = valid & CAMERA.in_image(pixels)
        pixels = pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
        view = FrameFeatures(
            index=row,
            timestamp=0.5 * row,
            keypoints=pixels,
            scales=torch.ones(len(pixels), dtype=torch.float64),
            angles=torch.zeros(len(pixels), dtype=torch.float64),
            descriptors=torch.zeros(len(pixels), 32, dtype=torch.uint8),
            mask=valid,
        )
        seen = torch.nonzero(valid)[:, 0]
        known = ids[first : first + REACH].flatten()
        if row % 2 == 0:
            keyframe = submap.map.add_keyframe(view, T_ce[row])
            new = seen[known[seen] < 0]
            rows = first * per_keyframe + new
            covariances = 1e-4 * torch.eye(3, dtype=torch.float64).expand(len(new), 3, 3)
            ids.view(-1)[rows] = submap.map.add_points(
                shown[new], view.descriptors[new], keyframe, covariances
            )
            known = ids[first : first + REACH].flatten()
            submap.map.add_observations(keyframe, seen, known[seen])
        seen = seen[known[seen] >= 0]
        T_cr = T_ce[row] @ se3_inverse(submap.map.T_cw[keyframe])
        submap.posed_frames.add(view, estimate_at(T_ce[row], known[seen], seen), T_cr, keyframe)
    graph = submap.posed_frames.graph(submap.map, CAMERA)
    solution = solve_graph(graph, options=GRAPH_OPTIONS.replace(backward="detached"))
    submap.posed_frames.apply_solution(solution, graph, submap.map)
    return submap, 0.5 * torch.arange(len(T_ec), dtype=torch.float64), T_ec
