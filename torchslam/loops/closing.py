"""What follows a recognition: a loop is closed, or two worlds become one.

The map bends by a graph of similarities over its keyframes, so that the drift of position, direction and scale is
spread over the way; then points that are one are merged, and everything is adjusted.
Source: Strasdat, Montiel and Davison, "Scale drift-aware large scale monocular SLAM", 2010.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, se3_inverse, sim3_inverse
from torchslam.loops.essential_graph import essential_edges
from torchslam.loops.recognition import Recognition
from torchslam.loops.relation import neighbourhood
from torchslam.mapping.fusion import fuse
from torchslam.mapping.local_bundle import adjust_all
from torchslam.solvers import PoseGraph, pose_graph_optimize
from torchslam.world.world import World

_ITERATIONS = 20
_FUSED = 8  # keyframes on either side whose points are merged


def close_loop(found: Recognition, camera: Camera, config: Config) -> None:
    """Bend a world so that a keyframe lies to a place as it was recognised to; the first keyframe stays."""
    world = found.world
    world.correct(corrected(found))
    weld(world, found.keyframe, found.place, camera, config)


def corrected(found: Recognition) -> Tensor:
    """(K, 4, 4) similarities, world to keyframe, in which the loop is closed and the ways between bend least."""
    T_cw = found.world.map.T_cw
    edges = essential_edges(found.world.map)
    closing = edges.new_tensor([[found.place, found.keyframe]])
    measured = T_cw[edges[:, 1]] @ se3_inverse(T_cw[edges[:, 0]])
    # The keyframe sees world 1, which S_21 puts to where the place is.
    S_kp = T_cw[found.keyframe] @ sim3_inverse(found.relation.S_21) @ se3_inverse(T_cw[found.place])
    graph = PoseGraph(T_cw, torch.cat([edges, closing]), torch.cat([measured, S_kp[None]]), fixed=(0,))
    return pose_graph_optimize(graph, backward="detached", iterations=_ITERATIONS).S_cw


def join(found: Recognition, camera: Camera, config: Config) -> tuple[World, int]:
    """Make one world of two: the younger one moves to where the older one has the place.

    Returns the older one and the row of the keyframe in it. The camera stays where it was last.
    """
    world, other, relation = found.world, found.other, found.relation
    if other.number < world.number:
        offset = other.map.num_keyframes
        other.absorb(world, relation.S_21)
        weld(other, found.keyframe + offset, found.place, camera, config)
        return other, found.keyframe + offset
    offset = world.map.num_keyframes
    track = world.track
    world.absorb(other, sim3_inverse(relation.S_21))
    world.track = track
    weld(world, found.keyframe, found.place + offset, camera, config)
    return world, found.keyframe


def weld(world: World, keyframe: int, place: int, camera: Camera, config: Config) -> None:
    """Merge the points that the surroundings of a keyframe and of a place both see, and adjust the whole map."""
    here = neighbourhood(world.map, keyframe, _FUSED)
    there = neighbourhood(world.map, place, _FUSED)
    for one in here.tolist():
        fuse(world.map, one, there[there != one], camera, config)
    world.map.refresh(torch.unique(torch.cat([here, there])))
    if config.loops.adjust and config.bundle.enabled:
        adjust_all(world.map, camera, config.bundle)
