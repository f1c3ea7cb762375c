"""A circular path with drift whose end sees the scene of its start as separate points."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from tests.map.simulated import estimate_at
from tests.scene import CAMERA, Scene, pose
from torchslam.config import Config
from torchslam.geometry import SharedCamera, rigid, se3_exp, se3_inverse, so3_exp
from torchslam.map.atlas import Submap
from torchslam.tracking.tracker import Tracker

KEYFRAMES = 30
EARLY, LATE = 7, 18  # points seen by the first seven are duplicated from the eighteenth on
END = KEYFRAMES - 1


def ring(points: int = 700) -> Scene:
    """Points on a wall around the circle."""
    scene = Scene.of(points)
    generator = torch.Generator().manual_seed(4)
    draw = torch.rand(points, 3, generator=generator, dtype=torch.float64)
    angle, radius = 2 * math.pi * draw[:, 0], 5 + 2 * draw[:, 1]
    points_w = torch.stack([radius * angle.sin(), 3 * draw[:, 2] - 1.5, radius * angle.cos()], -1)
    return Scene(points_w, scene.sizes, scene.descriptors)


def around(count: int = KEYFRAMES) -> Tensor:
    """(K, 4, 4) T_cw of cameras on the circle that look at the wall."""
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    zero = torch.zeros_like(angle)
    R_wc = so3_exp(torch.stack([zero, angle, zero], -1))
    return se3_inverse(rigid(R_wc, R_wc @ torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)))


def ring_submap(scale: float = 1.0, twist: float = 0.0) -> Submap:
    """One round in the frame of the first camera; per keyframe the scale drifts by `scale` and the path bends."""
    scene, T_cw = ring(), around()
    submap = Submap.empty(0, CAMERA.params)
    rows: dict[tuple[int, bool], int] = {}
    early: set[int] = set()
    for keyframe, true in enumerate(T_cw):
        view = scene.view(keyframe, true)
        at = torch.nonzero(view.mask)[:, 0]
        seen = scene.shows(keyframe)[at].tolist()
        submap.map.add_keyframe(view, true)
        names = [(point, keyframe >= LATE and point in early) for point in seen]
        fresh = [name for name in names if name not in rows]
        rows |= {name: len(rows) + offset for offset, name in enumerate(fresh)}
        if fresh:
            new_points = torch.tensor([point for point, _ in fresh])
            submap.map.add_points(scene.points_w[new_points], scene.descriptors[new_points], keyframe)
        if keyframe < EARLY:
            early.update(seen)
        ids = torch.tensor([rows[name] for name in names])
        submap.map.add_observations(keyframe, at, ids)
        submap.posed_frames.add(view, estimate_at(true, ids, at), pose(), keyframe)
    submap.map.update_appearance(torch.arange(KEYFRAMES))
    submap.apply_sim3_correction(drifted(T_cw, scale, twist))
    Tracker(SharedCamera(CAMERA), Config()).reset_to_keyframe(submap, END)
    return submap


def drifted(T_cw: Tensor, scale: float, twist: float) -> Tensor:
    """(K, 4, 4) similarities of a path with a small error in every step, the first one at the origin."""
    step = se3_exp(torch.tensor([0, 0, 0, twist, 0.5 * twist, 0], dtype=torch.float64))
    step[:3, :3] *= scale
    S_cw = [torch.eye(4, dtype=torch.float64)]
    for before, after in itertools.pairwise(T_cw):
        S_cw.append(step @ after @ se3_inverse(before) @ S_cw[-1])
    return torch.stack(S_cw)


def scaling_sim3(scale: float) -> Tensor:
    """The Sim(3) that only scales."""
    return torch.diag(torch.tensor([scale, scale, scale, 1], dtype=torch.float64))
