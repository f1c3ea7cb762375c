"""Loop closing: detect known places, correct the drift of a loop, and merge submaps that share a place.

A closed loop bends the map by a pose graph of Sim(3) over the essential graph of its keyframes, which spreads the drift
of position, rotation and scale along the loop. Then duplicate landmarks are fused and the whole map is adjusted.
Sources: Strasdat, Montiel and Davison, "Scale drift-aware large scale monocular SLAM", 2010; Mur-Artal, Montiel and
Tardos, "ORB-SLAM: a versatile and accurate monocular SLAM system", 2015, section VII.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, SharedCamera, se3_inverse, sim3_inverse
from torchslam.loop_closing.keyframe_database import KeyframeDatabase
from torchslam.loop_closing.loop_detector import LoopCandidate, LoopDetector
from torchslam.loop_closing.records import LoopClosureRecord, LoopEdge, LoopMatches, no_matches
from torchslam.map.atlas import Atlas, Submap
from torchslam.map.map import Map
from torchslam.mapping.local_bundle import adjust_all
from torchslam.mapping.new_points import fuse
from torchslam.optim import POSE_GRAPH_OPTIONS, PoseGraph, solve_pose_graph
from torchslam.tracking.tracker import MAX_CANDIDATES, Candidate
from torchslam.types import FrameFeatures, Matcher

MIN_ESSENTIAL_WEIGHT = 100
"""Shared points of two keyframes with an edge in addition to the spanning tree. Mur-Artal et al., 2015, III.D."""
_MAX_STRONG_EDGES = 20
"""Such edges of a keyframe at most: the graph stays sparse where a camera stands. Tried at this value only."""
_ITERATIONS = 20
"""Iterations of the pose graph, as in ORB-SLAM."""
_VISIT_KEYFRAMES = 20
"""Keyframes on either side of the loop in which the other side's points are searched for. Tried at this value only."""


class LoopCloser:
    """Detects and closes loops over all submaps of an atlas.

    Attributes:
        loop_closures: records of all loop closures and merges so far.
        loop_precheck: key of the last keyframe of `precheck`, and whether a loop was detected.
    """

    def __init__(
        self, camera: SharedCamera, config: Config, atlas: Atlas, matcher: Matcher | None = None
    ) -> None:
        self.camera = camera
        self.config = config
        self.atlas = atlas
        self.keyframe_database = KeyframeDatabase()
        self.loop_detector = LoopDetector(camera, config, atlas, self.keyframe_database, matcher)
        self.loop_closures: list[LoopClosureRecord] = []
        self.loop_precheck: tuple[int, bool] | None = None
        for submap in atlas:
            for keyframe in range(submap.map.num_keyframes):
                self.add(submap.map, keyframe)

    def restore(self, loop_closures: list[LoopClosureRecord], loop_precheck: tuple[int, bool] | None) -> None:
        """Continue from the state of a checkpoint."""
        self.loop_closures, self.loop_precheck = loop_closures, loop_precheck

    def add(self, slam_map: Map, keyframe: int) -> None:
        """Add a keyframe to the keyframe database."""
        view = slam_map.frame_features(keyframe)
        self.keyframe_database.add(slam_map.key(keyframe), view.descriptors, view.mask)

    def remove(self, keys: Int[Tensor, " K"]) -> None:
        """Remove keyframes by their keys from the keyframe database."""
        self.keyframe_database.remove(keys)

    def query(self, view: FrameFeatures) -> list[Candidate]:
        """Return relocalization candidates in all submaps, most similar first."""
        keys, _ = self.keyframe_database.query(view.descriptors, view.mask)
        found = (self.atlas.find(key) for key in keys[: 3 * MAX_CANDIDATES].tolist())
        return [candidate for candidate in found if candidate is not None]

    def precheck(self, submap: Submap, keyframe: int) -> None:
        """Record whether a loop is detected before the local adjustment is applied; the map is not changed."""
        is_known = (
            self.config.loop_closing.enabled and self.loop_detector.detect(submap, keyframe) is not None
        )
        self.loop_precheck = submap.map.key(keyframe), is_known

    def detect(self, submap: Submap, keyframe: int) -> LoopCandidate | None:
        """Return the verified loop candidate of a keyframe; None if there is none, or if `precheck` found none."""
        looks_new = self.loop_precheck == (submap.map.key(keyframe), False)
        if looks_new or not self.config.loop_closing.enabled:
            return None
        return self.loop_detector.detect(submap, keyframe)

    def fuse_with_earlier_visits(self, submap: Submap, keyframe: int) -> None:
        """Fuse the landmarks of a keyframe without a loop with those of covisible keyframes of earlier visits."""
        if self.config.loop_closing.enabled:
            fuse_with_earlier_visits(submap, keyframe, self.camera.current, self.config)

    def close(self, found: LoopCandidate) -> tuple[Submap, int]:
        """Close a loop or merge two submaps; return the submap and the row of the keyframe in it."""
        edge = loop_edge(found)
        self.loop_closures.append(replace(found.closure, edge=edge))
        if found.is_loop:
            close_loop(found, edge.graph, self.camera.current, self.config)
            return found.submap, found.keyframe
        submap, keyframe = merge_maps(found, self.camera.current, self.config)
        self.atlas.remove(found.submap if submap is found.matched_submap else found.matched_submap)
        return submap, keyframe


def close_loop(found: LoopCandidate, graph: PoseGraph, camera: Camera, config: Config) -> None:
    """Correct the drift of a submap by the pose graph of `loop_edge`, then fuse landmarks; the first keyframe stays."""
    submap = found.submap
    submap.apply_sim3_correction(essential_graph_solution(graph))
    fuse_and_adjust(submap, found.keyframe, found.matched_keyframe, camera, config)


def essential_graph_solution(graph: PoseGraph) -> Float[Tensor, "K 4 4"]:
    """Optimize the pose graph of a loop; return Sim(3), world to keyframe."""
    options = POSE_GRAPH_OPTIONS.replace(iterations=_ITERATIONS, backward="detached")
    return solve_pose_graph(graph, options=options).S_cw


def loop_edge(found: LoopCandidate) -> LoopEdge:
    """The measured loop in the essential graph, or the measured relation of two submaps: copies that autograd can use.

    The last edge is the measured one.
    """
    here, there = found.submap.map, found.matched_submap.map
    T_wm = se3_inverse(there.T_cw[found.matched_keyframe])
    S_km = here.T_cw[found.keyframe] @ sim3_inverse(found.S_21) @ T_wm
    if found.is_loop:
        rows, S_cw = [(here, slice(None))], here.T_cw
        edges = essential_edges(here)
        measured = S_cw[edges[:, 1]] @ se3_inverse(S_cw[edges[:, 0]])
        edges = torch.cat([edges, edges.new_tensor([[found.matched_keyframe, found.keyframe]])])
        S_ji = torch.cat([measured, S_km[None]])
    else:
        rows = [(there, slice(found.matched_keyframe, found.matched_keyframe + 1))]
        rows.append((here, slice(found.keyframe, found.keyframe + 1)))
        edges, S_ji = here.index_tensor(0, 1)[None], S_km[None]
        S_cw = torch.stack((torch.eye(4, dtype=S_km.dtype, device=S_km.device), S_km))
    origin = [
        torch.cat([each.keyframes[name][row] for each, row in rows]) for name in ("frame_index", "session")
    ]
    matches = no_matches(S_cw) if found.matches is None else found.matches
    with torch.inference_mode(False):
        own = LoopMatches(*(each.clone() for each in matches))
        return LoopEdge(own, *(each.clone() for each in (S_cw, edges, S_ji, *origin)))


def merge_maps(found: LoopCandidate, camera: Camera, config: Config) -> tuple[Submap, int]:
    """Merge the newer of two submaps into the older one; return it and the row of the keyframe in it.

    The tracking state stays that of the keyframe's submap.
    """
    submap, other = found.submap, found.matched_submap
    if other.number < submap.number:
        offset = other.map.num_keyframes
        other.merge(submap, found.S_21)
        fuse_and_adjust(other, found.keyframe + offset, found.matched_keyframe, camera, config)
        return other, found.keyframe + offset
    offset = submap.map.num_keyframes
    tracking = submap.tracking
    submap.merge(other, sim3_inverse(found.S_21))
    submap.tracking = tracking
    fuse_and_adjust(submap, found.keyframe, found.matched_keyframe + offset, camera, config)
    return submap, found.keyframe


def fuse_and_adjust(
    submap: Submap, keyframe: int, matched_keyframe: int, camera: Camera, config: Config
) -> None:
    """Fuse landmarks between the neighborhoods of two keyframes, and adjust the whole map, twice.

    Before the first adjustment some points are too far from their keypoints to be matched.
    """
    here = submap.map.neighborhood(keyframe, _VISIT_KEYFRAMES)
    there = submap.map.neighborhood(matched_keyframe, _VISIT_KEYFRAMES)
    fuse_landmarks(submap.map, here, there, camera, config)
    if not config.paper.unrefined:
        adjust_all(submap.map, camera)
        fuse_landmarks(submap.map, here, there, camera, config)
        adjust_all(submap.map, camera)


def fuse_with_earlier_visits(submap: Submap, keyframe: int, camera: Camera, config: Config) -> None:
    """Fuse the landmarks of a keyframe with those of covisible keyframes of earlier visits.

    After a loop closure, the most covisible keyframes, which tracking and mapping use, are mostly of the same visit.
    """
    earlier = earlier_visit_keyframes(submap.map, keyframe)
    if len(earlier):
        fuse_landmarks(submap.map, submap.map.index_tensor(keyframe), earlier, camera, config)
        tracking = submap.tracking  # must not refer to merged points
        tracking.local_points = torch.unique(submap.map.follow_merges(tracking.local_points))
        tracking.last_inlier_points = submap.map.follow_merges(tracking.last_inlier_points)


def earlier_visit_keyframes(slam_map: Map, keyframe: int) -> Int[Tensor, " R"]:
    """Return at most 20 covisible keyframes of earlier visits: before the last gap in covisibility over time."""
    order = torch.argsort(slam_map.keys)
    rank = torch.argsort(order)
    shares = slam_map.count_observed(slam_map.observed_points(slam_map.index_tensor(keyframe)))[order] > 0
    missing = torch.nonzero(~shares[: int(rank[keyframe])])[:, 0]
    began = int(missing[-1]) + 1 if len(missing) else 0
    near = slam_map.covisible_keyframes(keyframe, slam_map.num_keyframes)
    return near[rank[near] < began][:_VISIT_KEYFRAMES]


def fuse_landmarks(
    slam_map: Map, here: Int[Tensor, " K"], there: Int[Tensor, " L"], camera: Camera, config: Config
) -> None:
    """Match the points of two sets of keyframes in each other, and merge duplicates."""
    fuse(slam_map, here, there, camera, config)
    slam_map.update_appearance(torch.unique(torch.cat([here, there])))


def essential_edges(slam_map: Map) -> Int[Tensor, "E 2"]:
    """Return the essential graph: edges of a spanning tree and of strongly covisible keyframes.

    The parent in the tree is the most covisible earlier keyframe, or else the row before.
    """
    edges: set[tuple[int, int]] = set()
    for keyframe in range(1, slam_map.num_keyframes):
        near = slam_map.covisible_keyframes(keyframe, slam_map.num_keyframes, min_shared=1)
        earlier = near[near < keyframe]
        edges.add((int(earlier[0]) if len(earlier) else keyframe - 1, keyframe))
        strong = slam_map.covisible_keyframes(keyframe, _MAX_STRONG_EDGES, min_shared=MIN_ESSENTIAL_WEIGHT)
        edges.update((other, keyframe) for other in strong.tolist() if other < keyframe)
    return torch.tensor(sorted(edges), dtype=torch.int64, device=slam_map.T_cw.device).reshape(-1, 2)
