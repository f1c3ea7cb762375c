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
from torchslam.loop_closing.essential_graph import essential_edges
from torchslam.loop_closing.loop_detector import LoopCandidate
from torchslam.loop_closing.relative_sim3 import neighbourhood
from torchslam.map.map import Map
from torchslam.map.submap import Submap
from torchslam.mapping.fusion import find_in, merge
from torchslam.mapping.local_bundle import adjust_all
from torchslam.optim import PoseGraph, pose_graph_optimize

_ITERATIONS = 20
_SIDE = 20  # keyframes on either side of a seam that are searched for the other's points: what a visit has


def close_loop(found: LoopCandidate, camera: Camera, config: Config) -> None:
    """Bend a world so that a keyframe lies to a place as it was recognised to; the first keyframe stays."""
    world = found.world
    world.correct(corrected(found))
    weld(world, found.keyframe, found.place, camera, config)


def corrected(found: LoopCandidate) -> Tensor:
    """(K, 4, 4) similarities, world to keyframe, in which the loop is closed and the ways between bend least."""
    T_cw = found.world.map.T_cw
    edges = essential_edges(found.world.map)
    closing = edges.new_tensor([[found.place, found.keyframe]])
    measured = T_cw[edges[:, 1]] @ se3_inverse(T_cw[edges[:, 0]])
    # The keyframe sees world 1, which S_21 puts to where the place is.
    S_kp = T_cw[found.keyframe] @ sim3_inverse(found.relation.S_21) @ se3_inverse(T_cw[found.place])
    graph = PoseGraph(T_cw, torch.cat([edges, closing]), torch.cat([measured, S_kp[None]]), fixed=(0,))
    return pose_graph_optimize(graph, backward="detached", iterations=_ITERATIONS).S_cw


def join(found: LoopCandidate, camera: Camera, config: Config) -> tuple[Submap, int]:
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


def weld(world: Submap, keyframe: int, place: int, camera: Camera, config: Config) -> None:
    """Merge the points that the surroundings of a keyframe and of a place both see, and adjust the whole map.

    Then once more: where the map was bent, points lie too far from their keypoints to be found, and adjusted they do
    not.
    """
    here = neighbourhood(world.map, keyframe, _SIDE)
    there = neighbourhood(world.map, place, _SIDE)
    sew(world.map, here, there, camera, config)
    if config.loop_closing.global_bundle_adjustment and config.bundle_adjustment.local:
        adjust_all(world.map, camera, config.bundle_adjustment)
        sew(world.map, here, there, camera, config)
        adjust_all(world.map, camera, config.bundle_adjustment)


def sew_on(world: Submap, keyframe: int, camera: Camera, config: Config) -> None:
    """Merge what a keyframe sees with what is seen by those that were here at another time.

    For after a loop was closed: the way goes on over the seam, and what tracking and mapping find by the keyframes that
    share most with the new one are mostly those of the same visit.
    """
    earlier = other_visits(world.map, keyframe)
    if len(earlier):
        sew(world.map, world.map.ids(keyframe), earlier, camera, config)
        track = world.track  # looks for the heirs of merged points
        track.local_points = torch.unique(world.map.resolve(track.local_points))
        track.seen_last = world.map.resolve(track.seen_last)


def other_visits(slam_map: Map, keyframe: int) -> Tensor:
    """(<= 20,) keyframes that share many points with this one, but not by way of those before it in time."""
    order = torch.argsort(slam_map.keys)
    rank = torch.argsort(order)
    shares = slam_map.observers(slam_map.points_seen_by(slam_map.ids(keyframe)))[order] > 0
    missing = torch.nonzero(~shares[: int(rank[keyframe])])[:, 0]
    began = int(missing[-1]) + 1 if len(missing) else 0
    near = slam_map.covisible(keyframe, slam_map.num_keyframes)
    return near[rank[near] < began][:_SIDE]


def sew(slam_map: Map, here: Tensor, there: Tensor, camera: Camera, config: Config) -> None:
    """Find what keyframes (k,) see in others (l,), and the other way round; merge what turns out to be one point."""
    for keyframes, others in ((here, there), (there, here)):
        points = slam_map.points_seen_by(others)
        merge(slam_map, *find_in(slam_map, keyframes, points, camera, config))
    slam_map.refresh(torch.unique(torch.cat([here, there])))
